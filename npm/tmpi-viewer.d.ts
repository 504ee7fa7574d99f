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
  /** Bytes of the photo that have arrived, and their share, 0 to 1. Not for rooms. */
  progress: { received: number; total: number; totalProgress: number };
  /** The scene is shown. */
  load: { mode: Mode };
  /** The camera has moved, by input or by itself. */
  'camera-change': { pose: Pose };
  /** The photo cannot be shown, or only as a flat picture. */
  error: { message: string };
  /** The state of a room has changed. */
  state: { state: RoomState; reason: string };
  /** Statistics of a room, twice a second while it is live. */
  statistics: RoomStatistics;
  /** A room's sound was turned on or off. */
  sound: { on: boolean };
}

/** `<tmpi-viewer src="photo.tmpi" alt="What it shows">`: a 3D photo, or a room. Text properties are empty if the attribute is missing. */
export interface TmpiViewerElement extends HTMLElement {
  /**
   * Address of a container, or of a room (`https://HOST/live/ROOM#token=TOKEN`). If its path ends in `/atlas`, browsers without a GPU show
   * views that the server draws.
   */
  get src(): string;
  set src(address: string | null | undefined);
  /** Name of a room, in place of its address; `src` is then the server's address, by default this page's server. */
  get room(): string;
  set room(name: string | null | undefined);
  /** The viewer's token for a room, if the address has none. */
  get token(): string;
  set token(token: string | null | undefined);
  /** Address of the server's views, if it is not beside `src`. */
  get view(): string;
  set view(address: string | null | undefined);
  /** Description of the photo. `aria-label` takes precedence; `title` is the fallback. */
  get alt(): string;
  set alt(text: string | null | undefined);
  /** Address of a picture to show until the photo has arrived. */
  get poster(): string;
  set poster(address: string | null | undefined);
  /** `contain` (default) shows all of the photo; `cover` fills the element and cuts off the rest. */
  get fit(): string;
  set fit(fit: 'contain' | 'cover' | (string & {}) | null | undefined);
  /** `lazy` (default) fetches the photo when it comes near the screen; `eager` fetches it at once. */
  get loading(): string;
  set loading(loading: 'lazy' | 'eager' | (string & {}) | null | undefined);
  /** `auto` (default), or `interaction`: fetches the photo when it is hovered, touched or focused. */
  get reveal(): string;
  set reveal(reveal: 'auto' | 'interaction' | (string & {}) | null | undefined);
  /**
   * How it moves without input: `swing`, `orbit`, `dolly`, `dolly-zoom`, `zoom` or `none`. The default is the owner's setting, else
   * `swing`. A room moves only if this or `auto-rotate` is set.
   */
  get motion(): string;
  set motion(style: 'swing' | 'orbit' | 'dolly' | 'dolly-zoom' | 'zoom' | 'none' | (string & {}) | null | undefined);
  /** How fast it moves without input, 0.25 to 4 times the default. */
  get speed(): string;
  set speed(rate: string | number | null | undefined);
  /** Whether it moves without input; `off` turns it off. */
  get autoRotate(): boolean;
  set autoRotate(on: boolean | string | null | undefined);
  /** Whether it takes input; `off` turns it off. */
  get cameraControls(): boolean;
  set cameraControls(on: boolean | string | null | undefined);
  /** Whether it has a full-screen button; `off` removes it. */
  get fullscreen(): boolean;
  set fullscreen(on: boolean | string | null | undefined);
  /** Whether it stays still until there is input. Off by default; the attribute needs no value. */
  get still(): boolean;
  set still(on: boolean | string | null | undefined);
  /** Whether it fetches the owner's settings of the camera from the server; `off` turns it off. */
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
  /**
   * Whether a room's sound is played. Setting it sets the attribute: `off` removes the sound button; without a value, sound starts with the
   * first tap or key.
   */
  get sound(): boolean;
  set sound(on: boolean | string | null | undefined);
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
