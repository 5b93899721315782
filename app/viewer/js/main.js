/** The page put together: the parts, what they show, and who tells whom. */
import { App } from './app.js';
import { ChartPanel } from './panels/charts.js';
import { Dialogs } from './panels/dialogs.js';
import { showDemo } from './panels/demo.js';
import { showDetail } from './panels/detail.js';
import { Legend } from './panels/legend.js';
import { showNotice, showState } from './panels/notice.js';
import { showPeople } from './panels/people.js';
import { toast } from './panels/toasts.js';
import { Transport } from './panels/transport.js';
import { Stage } from './scene/stage.js';
import { byId } from './dom.js';
import { takeCode } from './key.js';
import { listenToKeys } from './shortcuts.js';
import { startTheme } from './theme.js';
import { View } from './view.js';
import { takeDrops } from './files/drop.js';

const code = takeCode(); // before anything can fail: it must not stay in the address
export const app = new App();
export const stage = makeStage();
export const view = new View(app, stage);

function makeStage() {
  try {
    return new Stage(byId('stage'));
  } catch (error) {
    byId('banner').textContent = 'This browser cannot draw in 3D: WebGL is off or missing.';
    byId('banner').hidden = false;
    throw error;
  }
}

const transport = new Transport(view, byId('transport'));
const legend = new Legend(view);
const charts = new ChartPanel(app, view);
const dialogs = new Dialogs(app);
const theme = startTheme(byId('theme'), () => {
  view.paint();
  charts.paint();
});

function showAll() {
  showState(app);
  showPeople(app, byId('people'));
  showDemo(app, byId('demo'));
  showDetail(app, byId('detail'));
  showNotice(app, dialogs, byId('notice'));
  transport.show();
  legend.show();
  dialogs.show();
}

app.on('change', showAll);
app.on('figures', () => view.meet());
app.on('toast', ({ text, bad }) => toast(text, bad));
view.on('change', () => {
  transport.show();
  legend.show();
});
byId('add-open').addEventListener('click', () => dialogs.openAdd());
byId('help-open').addEventListener('click', () => dialogs.openHelp());
byId('sign-out').addEventListener('click', () => app.signOut());
takeDrops(document.body, (file) => app.playFile(file));
listenToKeys({ app, view, stage, dialogs, theme });
view.run(() => {
  transport.follow();
  legend.follow();
  charts.follow();
});

if (code) await app.redeem(code);
else await app.load();
