/** Making elements; text is always text, never markup. */

/** @type {WeakMap<Node, Record<string, (event: any) => void>>} */
const handlers = new WeakMap();
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
    if (name.startsWith('on')) listen(node, name.slice(2), value);
    else if (name === 'value' || name === 'checked') node[name] = value;
    else node.setAttribute(name, value === true ? '' : String(value));
  }
  const wanted = children.flat(Infinity).filter((child) => child || child === 0);
  node.append(...wanted.map((child) => (child.nodeType ? child : String(child))));
  return node;
}

/** Handlers are looked up when something happens, so that `replace` can exchange them. */
function listen(node, name, handler) {
  handlers.set(node, { ...handlers.get(node), [name]: handler });
  node.addEventListener(name, hear);
}

function hear(event) {
  handlers.get(event.currentTarget)?.[event.type]?.(event);
}

/** @param {string} id @returns {any} */
export function byId(id) {
  return document.getElementById(id);
}

/**
 * Make a node hold what is given. What is there already stays and is only changed where it differs: a
 * button that is being pressed, or has the focus, is still the same one afterwards.
 * @param {Element} node
 * @param {any[]} children
 */
export function replace(node, ...children) {
  adopt(node, h('div', {}, ...children));
}

function adopt(node, fresh) {
  const wanted = [...fresh.childNodes];
  wanted.forEach((child, i) => {
    const known = node.childNodes[i];
    if (!known) node.append(child);
    else if (isAlike(known, child)) change(known, child);
    else known.replaceWith(child);
  });
  while (node.childNodes.length > wanted.length) node.lastChild.remove();
}

function isAlike(a, b) {
  return a === b || (a.nodeName === b.nodeName
    && a.getAttribute?.('data-key') === b.getAttribute?.('data-key') && a.id === b.id);
}

function change(node, fresh) {
  if (node === fresh) return;
  if (node.nodeType === Node.TEXT_NODE) {
    if (node.data !== fresh.data) node.data = fresh.data;
    return;
  }
  for (const { name } of [...node.attributes]) if (!fresh.hasAttribute(name)) node.removeAttribute(name);
  for (const { name, value } of fresh.attributes) {
    if (node.getAttribute(name) !== value) node.setAttribute(name, value);
  }
  if ('checked' in node && node.checked !== fresh.checked) node.checked = fresh.checked;
  for (const name of Object.keys(handlers.get(fresh) ?? {})) {
    if (!handlers.get(node)?.[name]) node.addEventListener(name, hear);
  }
  handlers.set(node, handlers.get(fresh) ?? {});
  adopt(node, fresh);
}

/** An icon of the page's sprite. */
export function icon(name) {
  return svg('svg', { class: 'icon', 'aria-hidden': 'true', focusable: 'false' },
    svg('use', { href: `#i-${name}` }));
}
