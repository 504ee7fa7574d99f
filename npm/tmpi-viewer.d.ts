/** Where the camera is, in the photo's frame: lengths in units of the distance to the nearest thing, angles in degrees. */
export interface Pose {
  tx: number;
  ty: number;
  tz: number;
  yaw: number;
  pitch: number;
  roll: number;
}

/** How the scene is shown: by WebGPU, by WebGL2, by views that a server draws, as the photo alone, or a room as plain video. */
export type Mode = 'gpu' | 'webgl' | 'served' | 'still' | 'flat';

/**
 * How a room stands: `waiting` for somebody to go live, `full` where as many watch as may, `stalled` without new frames, `ended` for now, `away` where the server cannot be
 * reached, `refused` for want of a token, `none` where there is no such room, `unsupported` where the browser decodes no video of its kind.
 */
export type RoomState = 'connecting' | 'waiting' | 'full' | 'live' | 'stalled' | 'ended' | 'away' | 'refused' | 'none' | 'unsupported';

/** What is measured of a room, twice a second while it is live. */
export interface RoomStatistics {
  /** Number of the frame that is shown, -1 before the first. */
  frame: number;
  /** How far the picture is behind the camera, in ms. */
  behind: number;
  /** Frames a second. */
  frames: number;
  /** Data rate in kbit/s. */
  kbits: number;
  /** How many watch. */
  viewers: number;
  /** Frames that were skipped because this viewer reads too slowly. */
  skipped: number;
}

/** What the element fires, by name: the type of each event's `detail`. */
export interface TmpiViewerEvents {
  progress: { received: number; total: number; totalProgress: number };
  load: { mode: Mode };
  'camera-change': { pose: Pose };
  error: { message: string };
  state: { state: RoomState; reason: string };
  statistics: RoomStatistics;
  sound: { on: boolean };
}

/** `<tmpi-viewer src="photo.tmpi" alt="What it shows">`: a 3D photo, or a room in which it moves. Attributes are listed at the head of tmpi-viewer.js. */
export interface TmpiViewerElement extends HTMLElement {
  /** Attributes of these names; empty where there are none, and removed by null. */
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
  /** Whether it moves by itself: the attribute `auto-rotate`. */
  get autoRotate(): boolean;
  set autoRotate(on: boolean | string | null | undefined);
  /** Whether it takes input: the attribute `camera-controls`. */
  get cameraControls(): boolean;
  set cameraControls(on: boolean | string | null | undefined);
  /** Whether it has a button for full screen. */
  get fullscreen(): boolean;
  set fullscreen(on: boolean | string | null | undefined);
  /** Whether it stands still until somebody moves it. */
  get still(): boolean;
  set still(on: boolean | string | null | undefined);
  /** Whether it asks the server what the photo's owner wants of the camera. */
  get settings(): boolean;
  set settings(on: boolean | string | null | undefined);
  /** True once the scene is shown. */
  readonly loaded: boolean;
  /** The view at the present pose as a PNG file, in the photo's size. Rejects before something is shown. */
  toBlob(): Promise<Blob>;
  /** Eases back to where the photo was taken. */
  resetView(): void;
  /** How a room stands, or empty where none is shown. */
  readonly state: RoomState | '';
  /** True while a room's sound is played. */
  readonly sound: boolean;
  /** Plays a room's sound, or does not; on only from a tap. Rejects where the browser does not allow it, or no room is shown. */
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
