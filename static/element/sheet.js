// A style sheet of a shadow tree, adopted where the browser can do that, else as an element.

export class Sheet {
  #root;
  /** @type {CSSStyleSheet | null} */
  #sheet = null;
  /** @type {HTMLStyleElement | null} */
  #element = null;

  /** @param {ShadowRoot} root */
  constructor(root) {
    this.#root = root;
    try {
      this.#sheet = new CSSStyleSheet();
      root.adoptedStyleSheets = [...root.adoptedStyleSheets, this.#sheet];
    } catch {
      // Safari before 16.4
      this.#sheet = null;
      this.#element = document.createElement('style');
      root.append(this.#element);
    }
  }

  /** What it says. */
  set text(/** @type {string} */ css) {
    if (this.#sheet) this.#sheet.replaceSync(css);
    else if (this.#element) this.#element.textContent = css;
  }

  /** Takes it out of the tree. */
  remove() {
    this.#element?.remove();
    if (this.#sheet) this.#root.adoptedStyleSheets = this.#root.adoptedStyleSheets.filter((sheet) => sheet !== this.#sheet);
  }
}
