/** A problem document (RFC 9457), as the server answers whatever it refuses. */
export interface Problem {
  /** Kind of the problem, a URI that stays the same: `urn:tmpi:problem:…`. */
  type: string;
  title: string;
  /** HTTP status. */
  status: number;
  detail: string;
  /** Field, parameter or option that is at fault. */
  field?: string;
  request_id?: string;
  /** Seconds after which another try may succeed. */
  retry_after?: number;
}

/**
 * `refused`: the server refused, `problem` says why. `not-made`: the photo could not be made, or is damaged. `deleted`: it was deleted meanwhile.
 * `late`: it was not made in time. `silence`: nothing came. `connection`: none could be made, or it broke. `too-large`: more bytes than were
 * allowed. `answer`: none of this interface's. `input`: what was asked for cannot be asked.
 */
export type Reason = 'refused' | 'not-made' | 'deleted' | 'late' | 'silence' | 'connection' | 'too-large' | 'answer' | 'input';

export class TmpiError extends Error {
  constructor(reason: Reason, message: string, problem?: Problem);
  readonly reason: Reason;
  readonly problem?: Problem;
  /** HTTP status of the problem. */
  readonly status?: number;
}

export interface ClientOptions {
  /** A key of `tmpi key add`, or an owner's secret. Never in a page: whoever reads the page has it. */
  key?: string;
  /** A link to a page that ends with `#owner=` and an owner's secret. */
  ownerLink?: string;
  /** A link by which one photo can be seen and changed, and no other: `manage` of a {@link PhotoLink}, or `links.manage` of an upload. */
  manageLink?: string;
  /** Milliseconds of silence after which a request is given up; 60000. */
  silence?: number;
  /** Milliseconds before another try, at most; 30000. */
  longestPause?: number;
  /** How often a request is sent, at most; 4. */
  tries?: number;
  /** Bytes of a container, picture or export that are taken; 512 MiB. */
  maxBytes?: number;
}

export type Visibility = 'private' | 'link';
export type Picture = Blob | ArrayBuffer | Uint8Array<ArrayBuffer>;

export interface UploadOptions {
  /** 1 to 200 characters; else the file's name. */
  title?: string;
  visibility?: Visibility;
  /** A depth map in place of the estimated depth. */
  depth?: Picture;
  /** Options of `tmpi make` by their names. */
  options?: Record<string, string | number>;
  /** Seconds that the server may wait for the photo to be made before it answers. */
  wait?: number;
  signal?: AbortSignal;
}

export interface Offset {
  x: number;
  y: number;
  z: number;
}

/** What a photo's owner wants of viewers. */
export interface Settings {
  version: number;
  title?: string;
  motion?: Offset;
  focus?: number;
  start?: Offset;
  idle?: string;
  speed?: number;
  visibility?: Visibility;
  poster?: Offset;
}

/** Settings to change: what is missing stays, null leaves it to viewers. */
export type Change = {
  [K in Exclude<keyof Settings, 'version'>]?: Settings[K] extends Offset | undefined ? Partial<Offset> | null : Settings[K] | null;
};

export interface Progress {
  stage: string;
  /** Number of the stage, from 1. */
  step: number;
  steps: number;
  elapsed_ms: number;
}

/** Paths on the server; {@link Tmpi.address} makes addresses of them. */
export interface Links {
  self: string;
  atlas: string;
  thumbnail: string;
  poster: string;
  page: string;
  embed: string;
  /** Page by which to see and change this photo, for `manageLink`: a secret, told once to whoever uploads without one. */
  manage?: string;
}

export interface PhotoState {
  id: string;
  state: 'queued' | 'working' | 'done' | 'failed' | 'damaged';
  /** RFC 3339, UTC. */
  created: string;
  finished?: string;
  position?: number;
  waits_for?: string;
  progress?: Progress;
  problem?: Problem;
  photo_bytes: number;
  atlas_bytes?: number;
  width?: number;
  height?: number;
  version?: string;
  /** A network that is at hand and better than the one that estimated its depth, for whoever may have it made again. */
  better_depth?: string;
  visibility?: Visibility;
  settings: Settings;
  options: Record<string, string>;
  links: Links;
}

export interface PhotoList {
  /** Newest first. */
  photos: PhotoState[];
  next?: string;
}

export type TmpiEvent =
  | { type: 'queued'; data: { position: number } }
  | { type: 'stage'; data: Progress }
  | { type: 'done'; data: PhotoState }
  | { type: 'failed' | 'damaged'; data: Problem }
  | { type: 'deleted'; data: Record<string, never> };

export interface WaitOptions {
  /** Milliseconds, at most; 600000. */
  limit?: number;
  signal?: AbortSignal;
  onEvent?: (event: TmpiEvent) => void;
}

export interface Stroke {
  /** Its middle line, in shares of the photo's width and height. */
  points: [number, number][];
  /** As a share of the photo's longer side, 0.002 to 0.25. */
  radius: number;
  /** Disparity to add; less than 0 is farther. One of `by`, `like` and `to`. */
  by?: number;
  /** As near as this place. */
  like?: [number, number];
  /** This disparity, 0 is infinitely far. */
  to?: number;
}

export interface AtlasQuery {
  /** 0 the photo's own size, 1 half of it, 2 a quarter, 3 an eighth. */
  level?: 0 | 1 | 2 | 3;
  /** In place of a level: the smallest whose longer side has at least so many pixels. */
  fit?: number;
  /** Left, top, width and height in pixels of the photo at its own size. */
  region?: [number, number, number, number];
  sections?: ('index' | 'photo' | 'planes' | 'labels' | 'alpha' | 'hidden')[];
}

/** Lengths in units of the nearest distance, angles in degrees, sizes in pixels. */
export interface ViewQuery {
  tx?: number;
  ty?: number;
  tz?: number;
  yaw?: number;
  pitch?: number;
  roll?: number;
  w?: number;
  h?: number;
  fov?: number;
  /** Left, top, width and height in shares of the picture. */
  crop?: [number, number, number, number];
  format?: 'png' | 'jpeg' | 'webp' | 'mp4';
  stereo?: 'sbs' | 'anaglyph';
  /** `COLUMNSxROWS`. */
  quilt?: string;
  ipd?: number;
  focus?: number;
  path?: 'orbit' | 'swing' | 'dolly' | 'dolly-zoom' | 'zoom';
  frames?: number;
}

export interface Tagged<T> {
  value: T;
  etag: string | null;
}

export interface TmpiFile {
  bytes: Uint8Array<ArrayBuffer>;
  mediaType: string;
  etag: string | null;
}

export interface PhotoLink {
  page: string;
  atlas: string;
  query?: string;
  /** Seconds since 1970. */
  expires?: number;
  /** Page by which others see and change this photo, for `manageLink`: a secret, good until {@link Tmpi.takeLinksBack}. */
  manage?: string;
  /** Where whoever asks can let another browser be the same owner; missing where they have no secret of their own to pass on. */
  ticket?: string;
}

/** A server, as one caller sees it. All methods reject with a {@link TmpiError}, or with the reason of a `signal`. */
export class Tmpi {
  constructor(base: string, options?: ClientOptions);
  /** Address of a path that the server told; throws where it leads to another server. */
  address(path: string): string;
  /** Once this is answered, the photo is on the server's disk. */
  upload(photo: Picture, options?: UploadOptions): Promise<PhotoState>;
  state(id: string): Promise<Tagged<PhotoState>>;
  /** What happens to a photo, until it is made or will not be. */
  events(id: string, options?: { signal?: AbortSignal }): AsyncGenerator<TmpiEvent, void>;
  /** Follows the events; where these break off it asks for the state, ever more seldom. */
  wait(id: string, options?: WaitOptions): Promise<PhotoState>;
  list(query?: { limit?: number; after?: string }): Promise<PhotoList>;
  /** All photos, newest first, a page of `limit` at a time. */
  photos(limit?: number): AsyncGenerator<PhotoState, void>;
  report(id: string): Promise<Record<string, unknown>>;
  /** With `seen`, the tag of a state, only if its settings are still those. */
  change(id: string, settings: Change, seen?: string): Promise<Tagged<PhotoState>>;
  strokes(id: string): Promise<Tagged<{ version: number; strokes: Stroke[] }>>;
  /** Replaces all strokes; the photo is made again with them. */
  touchUp(id: string, strokes: Stroke[], seen?: string): Promise<Tagged<PhotoState>>;
  /** A link by which others read the photo for `seconds`, a day; and one by which they change it. */
  link(id: string, seconds?: number): Promise<PhotoLink>;
  /** All links to a photo, those that end and those to change it, are good no longer; for its owner alone. */
  takeLinksBack(id: string): Promise<void>;
  delete(id: string): Promise<void>;
  /** The container; null where `etag` is still its tag. */
  atlas(id: string, query?: AtlasQuery): Promise<TmpiFile>;
  atlas(id: string, query: AtlasQuery | undefined, etag: string | undefined): Promise<TmpiFile | null>;
  view(id: string, query?: ViewQuery): Promise<TmpiFile>;
  export(id: string, format?: 'html' | 'glb' | 'ora' | 'zip', shape?: 'relief' | 'metric'): Promise<TmpiFile>;
  thumbnail(id: string): Promise<TmpiFile>;
  /** Grey PNG of 16 bits, larger is nearer. */
  depth(id: string): Promise<TmpiFile>;
  /** A frame for a page of any site: of a photo that whoever has its address may see, or by a link, until that ends. */
  embed(state: PhotoState, link?: PhotoLink): string;
}
