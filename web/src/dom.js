// Elements of the page, made without markup: everything from the system is inserted as text.

/**
 * Return a new element.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, any>} [properties] `on...` are listeners, names with "-" and `role` attributes, others properties
 * @param {(Node | string)[]} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name.includes("-") || name === "role" || name === "for") element.setAttribute(name, value);
    else /** @type {any} */ (element)[name] = value;
  }
  element.append(...children);
  return element;
}

/**
 * Return a button that stays pressed or not.
 * @param {string} text @param {string} title @param {() => void} click
 */
export function toggle(text, title, click) {
  return h("button", { type: "button", title, onclick: click, "aria-pressed": "false" }, text);
}

/** @param {HTMLElement} button @param {boolean} pressed */
export const press = (button, pressed) => button.setAttribute("aria-pressed", String(pressed));

/**
 * Return a checkbox with its label.
 * @param {string} text @param {boolean} checked @param {(checked: boolean) => void} change
 */
export function checkbox(text, checked, change) {
  const box = h("input", { type: "checkbox", checked, onchange: () => change(box.checked) });
  return h("label", {}, box, ` ${text}`);
}

/**
 * Return a list of choices with its label.
 * @param {string} text @param {[string, string][]} options value and text @param {string} value @param {(value: string) => void} change
 */
export function choice(text, options, value, change) {
  const select = h("select", { onchange: () => change(select.value) }, ...options.map(([v, t]) => h("option", { value: v, selected: v === value }, t)));
  return h("label", {}, `${text} `, select);
}

/** Let the user save a file. @param {Blob} blob @param {string} name */
export function saveAs(blob, name) {
  const url = URL.createObjectURL(blob);
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000); // browsers read it after the click
}

let adopted = false;

/** Add the styles once, as a constructed sheet: the page's security policy forbids inline ones. @param {string} text */
export function adoptStyles(text) {
  if (adopted) return;
  adopted = true;
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(text);
  document.adoptedStyleSheets = [...document.adoptedStyleSheets, sheet];
}
