/** Making elements; text is always text, never markup. */

const SVG = 'http://www.w3.org/2000/svg';

/**
 * @param {string} tag
 * @param {Record<string, any>} [attributes] `class`, `on…` handlers, properties and attributes;
 *   false and null leave one out
 * @param {...(Node | string | number | null | false | undefined | any[])} children
 * @returns {any}
 */
export function h(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

/** The same for pictures. */
export function svg(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith('on')) node.addEventListener(name.slice(2), value);
    else if (name === 'value' || name === 'checked') node[name] = value;
    else node.setAttribute(name, value === true ? '' : String(value));
  }
  node.append(...children.flat(Infinity).filter((c) => c || c === 0).map((c) => c?.nodeType ? c : String(c)));
  return node;
}

/** @param {string} id @returns {any} */
export function byId(id) {
  return document.getElementById(id);
}

/**
 * Replace what is in a node, and keep the focus on the same control.
 * @param {HTMLElement} node
 * @param {any[]} children
 */
export function replace(node, ...children) {
  const fresh = h('div', {}, ...children);
  const focused = node.contains(document.activeElement)
    ? document.activeElement.getAttribute('data-key')
    : null;
  node.replaceChildren(...fresh.childNodes);
  if (focused) node.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
}

/** An icon of the page's sprite. */
export function icon(name) {
  return svg('svg', { class: 'icon', 'aria-hidden': 'true', focusable: 'false' },
    svg('use', { href: `#i-${name}` }));
}
