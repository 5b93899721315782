/** The API key: kept for this tab only, never in an address. */

const NAME = 'kinecast-key';

export function readKey() {
  return sessionStorage.getItem(NAME) ?? '';
}

/** @param {string} key empty forgets it */
export function keepKey(key) {
  if (key) sessionStorage.setItem(NAME, key);
  else sessionStorage.removeItem(NAME);
}

/** Take the one-time code out of the address, so that it does not stay in the history. */
export function takeCode() {
  const code = new URLSearchParams(location.hash.slice(1)).get('code');
  if (code) history.replaceState(null, '', location.pathname);
  return code ?? '';
}
