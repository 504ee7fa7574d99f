// A style sheet of a shadow tree: adopted, or a style element in old browsers.

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

  /** The style sheet's text. */
  set text(/** @type {string} */ css) {
    if (this.#sheet) this.#sheet.replaceSync(css);
    else if (this.#element) this.#element.textContent = css;
  }

  /** Removes it from the tree. */
  remove() {
    this.#element?.remove();
    if (this.#sheet) this.#root.adoptedStyleSheets = this.#root.adoptedStyleSheets.filter((sheet) => sheet !== this.#sheet);
  }
}
