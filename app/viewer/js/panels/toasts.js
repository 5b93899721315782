import { byId, h } from '../dom.js';

const SHOWN_MS = 6000;

/** Say something that passes; errors stay for longer. */
export function toast(text, isBad = false) {
  const message = h('div', { class: `toast${isBad ? ' bad' : ''}` },
    h('p', {}, text),
    h('button', { class: 'button small quiet', type: 'button', 'aria-label': 'Dismiss', onclick: () => message.remove() }, '×'));
  const toasts = byId('toasts');
  for (const old of [...toasts.children].slice(0, -2)) old.remove();
  toasts.append(message);
  setTimeout(() => message.remove(), isBad ? 2 * SHOWN_MS : SHOWN_MS);
}
