import { byId, h, replace } from '../dom.js';
import { SHORTCUTS } from '../shortcuts.js';

/** The sheets that lie over the page: sign in, add a person, help. */
export class Dialogs {
  constructor(app) {
    this.app = app;
    this.#makeSignIn();
    this.#makeHelp();
    byId('sign-in').addEventListener('cancel', (event) => event.preventDefault());
  }

  /** The key is asked for as long as there is none. */
  show() {
    const dialog = byId('sign-in');
    const isNeeded = this.app.phase === 'signed-out';
    if (isNeeded && !dialog.open) dialog.showModal();
    if (!isNeeded && dialog.open) dialog.close();
    this.wrong.textContent = this.app.problem;
    this.wrong.hidden = !this.app.problem;
  }

  #makeSignIn() {
    const key = h('input', {
      type: 'password', id: 'key', autocomplete: 'off', spellcheck: 'false', required: true, autofocus: true,
    });
    this.wrong = h('p', { class: 'wrong', role: 'alert', hidden: true });
    replace(byId('sign-in'), h('form', {
      onsubmit: (event) => {
        event.preventDefault();
        const given = key.value.trim();
        key.value = '';
        this.app.signIn(given);
      },
    },
    h('h2', { id: 'sign-in-title' }, 'Sign in'),
    h('p', {}, 'An admin key of this service. ', h('code', {}, 'kinecast serve'), ' shows it at the first start or says where it is.'),
    h('label', { class: 'field', for: 'key' }, 'Key', key, h('small', {}, 'Kept in this tab only, until you close it.')),
    this.wrong,
    h('div', { class: 'row' }, h('button', { class: 'button primary', type: 'submit' }, 'Sign in'))));
  }

  #makeHelp() {
    const dialog = byId('help');
    replace(dialog,
      h('h2', { id: 'help-title' }, 'What you see'),
      h('p', {}, 'The body is what the sensor sees now. The ghosts are where Kinecast expects it within the next half second. The hull holds each joint a fifth of a second from now with a probability of 90 %. The thin figure with dots is what was forecast for this very moment half a second ago: the closer it lies to the body, the better.'),
      h('dl', { class: 'keys' }, SHORTCUTS.map(([keys, text]) => [
        h('dt', {}, keys.split(' ').map((key) => h('kbd', {}, key))), h('dd', {}, text)])),
      h('div', { class: 'row' }, h('button', { class: 'button primary', type: 'button', onclick: () => dialog.close() }, 'Close')));
  }

  openHelp() { if (!byId('help').open) byId('help').showModal(); }

  openAdd() {
    const dialog = byId('add');
    if (dialog.open || this.app.phase !== 'ready') return;
    dialog.replaceChildren(this.#makeAdd(dialog)); // with empty fields
    dialog.showModal();
  }

  #makeAdd(dialog) {
    const id = h('input', { type: 'text', id: 'add-id', required: true, pattern: '[A-Za-z0-9][A-Za-z0-9._\\-]{0,63}', autocomplete: 'off', placeholder: 'ada' });
    const name = h('input', { type: 'text', id: 'add-name', maxlength: 200, autocomplete: 'off', placeholder: 'Ada L.' });
    const skeleton = h('select', { id: 'add-skeleton' }, this.app.skeletons.map((one) => h('option', { value: one.name }, one.name)));
    const up = h('select', { id: 'add-up' }, [['y', 'y: most recordings'], ['-y', '-y: camera frames'], ['z', 'z: robots and maps']]
      .map(([value, text]) => h('option', { value }, text)));
    const wrong = h('p', { class: 'wrong', role: 'alert', hidden: true });
    const submit = async (event) => {
      event.preventDefault();
      try {
        await this.app.addUser({ id: id.value, display_name: name.value.trim() || null, skeleton: skeleton.value, up: up.value });
        dialog.close();
      } catch (error) {
        wrong.textContent = error.message;
        wrong.hidden = false;
      }
    };
    return h('form', { onsubmit: submit },
      h('h2', { id: 'add-title' }, 'Add a person'),
      h('label', { class: 'field', for: 'add-id' }, 'Id', id, h('small', {}, 'Letters, digits, dots, dashes; it cannot be changed.')),
      h('label', { class: 'field', for: 'add-name' }, 'Name', name),
      h('div', { class: 'split' },
        h('label', { class: 'field', for: 'add-skeleton' }, 'Skeleton', skeleton),
        h('label', { class: 'field', for: 'add-up' }, 'Axis that points up', up)),
      wrong,
      h('div', { class: 'row' },
        h('button', { class: 'button', type: 'button', onclick: () => dialog.close() }, 'Cancel'),
        h('button', { class: 'button primary', type: 'submit' }, 'Add')));
  }
}
