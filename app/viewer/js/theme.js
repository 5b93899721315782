import { icon } from './dom.js';

const NAME = 'kinecast-theme';
const NEXT = { auto: 'light', light: 'dark', dark: 'auto' };
const SAID = { auto: 'Theme: as the system', light: 'Theme: light', dark: 'Theme: dark' };

/**
 * @param {HTMLElement} button goes through the themes
 * @param {() => void} onChange
 */
export function startTheme(button, onChange) {
  const root = document.documentElement;
  const set = (theme) => {
    root.dataset.theme = theme;
    button.setAttribute('aria-label', SAID[theme]);
    button.title = `${SAID[theme]} (T)`;
    button.replaceChildren(icon(theme));
    localStorage.setItem(NAME, theme);
    onChange();
  };
  const next = () => set(NEXT[root.dataset.theme]);
  button.addEventListener('click', next);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', onChange);
  const kept = localStorage.getItem(NAME);
  set(kept in NEXT ? kept : 'auto');
  return { next };
}
