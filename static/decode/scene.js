// A decoded scene: what the decoder gives, and what is drawn.

/** What a texel is, as in the server's `Class`. */
export const Class = { EMPTY: 0, PHOTO: 1, HIDDEN: 2 };
