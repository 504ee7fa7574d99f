/** The camera's pose in the photo's frame: lengths in units of the distance to the nearest surface, angles in degrees. */
export interface Pose {
  tx: number;
  ty: number;
  tz: number;
  yaw: number;
  pitch: number;
  roll: number;
}

/** How the scene is shown: by WebGPU, by WebGL2, by views that a server draws, as the photo alone, or (a room) as plain video. */
export type Mode = 'gpu' | 'webgl' | 'served' | 'still' | 'flat';

/**
 * State of a room: `waiting` for a publisher, `full` (viewer limit reached), `stalled` without new frames, `ended` for now, `away` (server
 * unreachable), `refused` without a valid token, `none` (no such room), `unsupported` (the browser cannot decode its video).
 */
export type RoomState = 'connecting' | 'waiting' | 'full' | 'live' | 'stalled' | 'ended' | 'away' | 'refused' | 'none' | 'unsupported';

/** Statistics of a room, twice a second while it is live. */
export interface RoomStatistics {
  /** Number of the shown frame, -1 before the first. */
  frame: number;
  /** How far the picture is behind the camera, in ms. */
  behind: number;
  /** Frames a second. */
  frames: number;
  /** Data rate in kbit/s. */
  kbits: number;
  /** Number of viewers. */
  viewers: number;
  /** Frames that were skipped because this viewer reads too slowly. */
  skipped: number;
}

/** Events that the element fires, by name: the type of each event's `detail`. */
export interface TmpiViewerEvents {
  progress: { received: number; total: number; totalProgress: number };
  load: { mode: Mode };
  'camera-change': { pose: Pose };
  error: { message: string };
  state: { state: RoomState; reason: string };
  statistics: RoomStatistics;
  sound: { on: boolean };
}

/** `<tmpi-viewer src="photo.tmpi" alt="What it shows">`: a 3D photo, or a room. Attributes are listed at the head of tmpi-viewer.js. */
export interface TmpiViewerElement extends HTMLElement {
  /** Attributes of these names; empty if missing, and removed by null. */
  get src(): string;
  set src(address: string | null | undefined);
  get room(): string;
  set room(name: string | null | undefined);
  get token(): string;
  set token(token: string | null | undefined);
  get view(): string;
  set view(address: string | null | undefined);
  get alt(): string;
  set alt(text: string | null | undefined);
  get poster(): string;
  set poster(address: string | null | undefined);
  get fit(): string;
  set fit(fit: 'contain' | 'cover' | (string & {}) | null | undefined);
  get loading(): string;
  set loading(loading: 'lazy' | 'eager' | (string & {}) | null | undefined);
  get reveal(): string;
  set reveal(reveal: 'auto' | 'interaction' | (string & {}) | null | undefined);
  get motion(): string;
  set motion(style: 'swing' | 'orbit' | 'dolly' | 'dolly-zoom' | 'zoom' | 'none' | (string & {}) | null | undefined);
  get speed(): string;
  set speed(rate: string | number | null | undefined);
  /** Whether it moves without input: the attribute `auto-rotate`. */
  get autoRotate(): boolean;
  set autoRotate(on: boolean | string | null | undefined);
  /** Whether it takes input: the attribute `camera-controls`. */
  get cameraControls(): boolean;
  set cameraControls(on: boolean | string | null | undefined);
  /** Whether it has a full-screen button. */
  get fullscreen(): boolean;
  set fullscreen(on: boolean | string | null | undefined);
  /** Whether it stays still until there is input. */
  get still(): boolean;
  set still(on: boolean | string | null | undefined);
  /** Whether it fetches the owner's camera settings from the server. */
  get settings(): boolean;
  set settings(on: boolean | string | null | undefined);
  /** True once the scene is shown. */
  readonly loaded: boolean;
  /** The current view as a PNG file, in the photo's size. Rejects while nothing is shown. */
  toBlob(): Promise<Blob>;
  /** Eases back to where the photo was taken. */
  resetView(): void;
  /** State of the room; empty for a photo. */
  readonly state: RoomState | '';
  /** True while a room's sound is played. */
  readonly sound: boolean;
  /** Turns a room's sound on or off. Turn it on only from a tap. Rejects if the browser does not allow it, or without a room. */
  setSound(on: boolean): Promise<void>;
  addEventListener<K extends keyof TmpiViewerEvents>(
    type: K,
    listener: (event: CustomEvent<TmpiViewerEvents[K]>) => void,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(type: string, listener: EventListenerOrEventListenerObject, options?: boolean | AddEventListenerOptions): void;
}

declare global {
  interface HTMLElementTagNameMap {
    'tmpi-viewer': TmpiViewerElement;
  }
}
