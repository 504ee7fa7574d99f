/** Where the camera is, in the photo's frame: lengths in units of the distance to the nearest thing, angles in degrees. */
export interface Pose {
  tx: number;
  ty: number;
  tz: number;
  yaw: number;
  pitch: number;
  roll: number;
}

/** How the scene is shown: by WebGPU, by WebGL2, by views that a server draws, or as the photo alone. */
export type Mode = 'gpu' | 'webgl' | 'served' | 'still';

/** What the element fires, by name: the type of each event's `detail`. */
export interface TmpiViewerEvents {
  progress: { received: number; total: number; totalProgress: number };
  load: { mode: Mode };
  'camera-change': { pose: Pose };
  error: { message: string };
}

/** `<tmpi-viewer src="photo.tmpi" alt="What it shows">`: a 3D photo. Attributes are listed at the head of tmpi-viewer.js. */
export interface TmpiViewerElement extends HTMLElement {
  /** True once the scene is shown. */
  readonly loaded: boolean;
  /** The view at the present pose as a PNG file, in the photo's size. Rejects before something is shown. */
  toBlob(): Promise<Blob>;
  /** Eases back to where the photo was taken. */
  resetView(): void;
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
