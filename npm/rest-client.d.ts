/** A problem document (RFC 9457): the server's answer when it refuses a request. */
export interface Problem {
  /** Kind of the problem, a stable URI: `urn:tmpi:problem:…`. */
  type: string;
  title: string;
  /** HTTP status. */
  status: number;
  detail: string;
  /** Field, parameter or option that is at fault. */
  field?: string;
  request_id?: string;
  /** Seconds after which you may try again. */
  retry_after?: number;
}

/**
 * `refused`: the server refused, `problem` says why. `not-made`: making the photo failed, or it is damaged. `deleted`: it was deleted
 * meanwhile. `late`: it was not made in time. `silence`: no data came. `connection`: it failed or broke. `too-large`: the answer exceeds
 * the limit. `answer`: the answer is not understood. `input`: the arguments are invalid.
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
  /** A key of `tmpi key add`, or an owner's secret. Never put it in a page: every reader of the page would have it. */
  key?: string;
  /** A link to a page that ends with `#owner=` and an owner's secret. */
  ownerLink?: string;
  /** A link that gives access to see and change one photo only: `manage` of a {@link PhotoLink}, or `links.manage` of an upload. */
  manageLink?: string;
  /** Milliseconds without data after which a request is given up; 60000. */
  silence?: number;
  /** Maximum milliseconds between tries; 30000. */
  longestPause?: number;
  /** Maximum number of tries of a request; 4. */
  tries?: number;
  /** Maximum bytes of a container, picture or export; 512 MiB. */
  maxBytes?: number;
}

export type Visibility = 'private' | 'link';
export type Picture = Blob | ArrayBuffer | Uint8Array<ArrayBuffer>;

export interface UploadOptions {
  /** 1 to 200 characters; else the file's name. */
  title?: string;
  visibility?: Visibility;
  /** A depth map to use instead of the estimated depth. */
  depth?: Picture;
  /** Options of `tmpi make` by their names. */
  options?: Record<string, string | number>;
  /** Maximum seconds that the server waits for the photo to be made before it answers. */
  wait?: number;
  signal?: AbortSignal;
}

export interface Offset {
  x: number;
  y: number;
  z: number;
}

/** Settings that a photo's owner chose for viewers. */
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

/** Settings to change: a missing field stays as it is, null leaves it to viewers. */
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

/** Paths on the server; {@link Tmpi.address} turns them into addresses. */
export interface Links {
  self: string;
  atlas: string;
  thumbnail: string;
  poster: string;
  page: string;
  embed: string;
  /** Page to see and change this photo, for `manageLink`: a secret, returned once, only to an uploader without credentials. */
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
  /** A better network than the one that estimated the depth, if the server has one and the caller may have the photo made again. */
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
  /** Maximum milliseconds; 600000. */
  limit?: number;
  signal?: AbortSignal;
  onEvent?: (event: TmpiEvent) => void;
}

export interface Stroke {
  /** Its middle line, in shares of the photo's width and height. */
  points: [number, number][];
  /** As a share of the photo's longer side, 0.002 to 0.25. */
  radius: number;
  /** Disparity to add; below 0 is farther. Set one of `by`, `like` and `to`. */
  by?: number;
  /** As near as this point. */
  like?: [number, number];
  /** This disparity; 0 is infinitely far. */
  to?: number;
}

export interface AtlasQuery {
  /** 0 is the photo's own size, 1 half of it, 2 a quarter, 3 an eighth. */
  level?: 0 | 1 | 2 | 3;
  /** Instead of a level: the smallest level whose longer side has at least this many pixels. */
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
  /** Page for others to see and change this photo, for `manageLink`: a secret, valid until {@link Tmpi.takeLinksBack}. */
  manage?: string;
  /** Route that issues tickets for other browsers; missing if the caller has no owner's secret. */
  ticket?: string;
}

/** A server, as one caller sees it. All methods reject with a {@link TmpiError}, or with the reason of an aborted `signal`. */
export class Tmpi {
  constructor(base: string, options?: ClientOptions);
  /** Address of a path that the server returned; throws if it leads to another server. */
  address(path: string): string;
  /** Once this resolves, the photo is on the server's disk. */
  upload(photo: Picture, options?: UploadOptions): Promise<PhotoState>;
  state(id: string): Promise<Tagged<PhotoState>>;
  /** Events of a photo until it is made, fails or is deleted. */
  events(id: string, options?: { signal?: AbortSignal }): AsyncGenerator<TmpiEvent, void>;
  /** Follows the events; if they break off, polls the state at growing intervals. */
  wait(id: string, options?: WaitOptions): Promise<PhotoState>;
  list(query?: { limit?: number; after?: string }): Promise<PhotoList>;
  /** All photos, newest first, a page of `limit` at a time. */
  photos(limit?: number): AsyncGenerator<PhotoState, void>;
  report(id: string): Promise<Record<string, unknown>>;
  /** With `seen`, the ETag of a state, changes the settings only if they are still the same. */
  change(id: string, settings: Change, seen?: string): Promise<Tagged<PhotoState>>;
  strokes(id: string): Promise<Tagged<{ version: number; strokes: Stroke[] }>>;
  /** Replaces all strokes; the photo is made again with them. */
  touchUp(id: string, strokes: Stroke[], seen?: string): Promise<Tagged<PhotoState>>;
  /** A link with which others can read the photo for `seconds` (default: a day), and one with which they can change it. */
  link(id: string, seconds?: number): Promise<PhotoLink>;
  /** Revokes all links to a photo, to see it and to change it; only its owner may call it. */
  takeLinksBack(id: string): Promise<void>;
  delete(id: string): Promise<void>;
  /** The container; null if `etag` still matches. */
  atlas(id: string, query?: AtlasQuery): Promise<TmpiFile>;
  atlas(id: string, query: AtlasQuery | undefined, etag: string | undefined): Promise<TmpiFile | null>;
  view(id: string, query?: ViewQuery): Promise<TmpiFile>;
  export(id: string, format?: 'html' | 'glb' | 'ora' | 'rgbd' | 'zip', shape?: 'relief' | 'metric'): Promise<TmpiFile>;
  thumbnail(id: string): Promise<TmpiFile>;
  /** A 16-bit grey PNG; larger is nearer. */
  depth(id: string): Promise<TmpiFile>;
  /** A frame for a page of any site. Its photo has visibility `link`, or a link that has not expired. */
  embed(state: PhotoState, link?: PhotoLink): string;
}
