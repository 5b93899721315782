/** The colours of the scene, those of the style sheet: Okabe and Ito's, with shapes beside them. */

/** @returns {Record<string, string>} by the names of the custom properties, without the dashes */
export function readPalette() {
  const style = getComputedStyle(document.documentElement);
  const names = ['stage', 'stage-far', 'grid', 'truth', 'personal', 'base', 'zero', 'miss', 'ink', 'muted', 'line', 'panel'];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}
