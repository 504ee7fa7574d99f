// Loads the parallax error of each tile from the photo's report, for the overlay `error`.

export class TileErrors {
  /** @type {Promise<number[]> | null} */
  #wanted = null;

  /** @param {string | undefined} address of the report, if there is one */
  constructor(address) {
    this.address = address;
  }

  /**
   * Passes the errors to `renderer` once they are loaded; does nothing before `want`.
   * @param {{setTileErrors: (errors: number[]) => void} | null} renderer
   */
  async show(renderer) {
    const errors = await this.#wanted;
    if (errors) renderer?.setTileErrors(errors);
  }

  /** Starts loading; `show` throws on a failure, and the next call tries again. */
  want() {
    if (this.#wanted || !this.address) return;
    const wanted = fetch(this.address).then(async (response) => {
      if (!response.ok) throw new Error('The report of the photo cannot be loaded.');
      return (await response.json()).error?.tile_px ?? [];
    });
    this.#wanted = wanted;
    wanted.catch(() => (this.#wanted = null));
  }
}
