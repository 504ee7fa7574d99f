// The parallax error of each tile, as the photo's report has it, for the overlay that shows it.

export class TileErrors {
  /** @type {Promise<number[]> | null} */
  #wanted = null;

  /** @param {string | undefined} address of the report, where there is one */
  constructor(address) {
    this.address = address;
  }

  /** Fetches the errors, once, and hands them to `renderer`; does nothing before `want`. */
  async show(renderer) {
    const errors = await this.#wanted;
    if (errors) renderer?.setTileErrors(errors);
  }

  /** Asks for them; a failure is told by `show` and forgotten. */
  want() {
    if (this.#wanted || !this.address) return;
    const wanted = fetch(this.address).then(async (response) => {
      if (!response.ok) throw new Error('The report of the photo cannot be had.');
      return (await response.json()).error?.tile_px ?? [];
    });
    this.#wanted = wanted;
    wanted.catch(() => (this.#wanted = null));
  }
}
