// The page's state and its socket. Messages: see Message.encode in rfedge/twin/board.py.
import { Street } from "/page/street.js";
import { Wall } from "/page/wall.js";
import { Inspector } from "/page/inspect.js";
import { Plots } from "/page/plots.js";
import { LiveView } from "/page/live.js";
import { StreetObjects } from "/page/objects.js";
import { showTiles } from "/page/tiles.js";

const RECONNECT_MS = 500;
const AGES_KEPT = 20000;
const element = (id) => document.getElementById(id);

// The camera that Follow looks along.
const select = (camera) => {
  state.selected = camera;
  wall.select(camera);
  street.select(camera);
  showFollowing();
};
// The camera that is seen in full, which the server compares with its field first.
const compare = (camera) => {
  state.compared = camera;
  send({ select: camera });
};
const street = new Street(element("street"));
const wall = new Wall(element("wall"), (camera) => {
  select(camera);
  compare(camera);
  inspector.open(camera);
});
const inspector = new Inspector(element("inspect"), () => compare(null));
const plots = new Plots(element("plots"));
const live = new LiveView(element("live"), street, (place) => send({ look: place }));
const objects = new StreetObjects(street, element("things"));
const state = { socket: null, selected: null, compared: null, isLive: false, pictures: 0, ages: [] };

function send(wish) {
  if (state.socket?.readyState === WebSocket.OPEN) state.socket.send(JSON.stringify(wish));
}

// The only camera needs no click.
function selectOnly() {
  const cameras = [...street.cameras.keys()];
  if (!cameras.includes(street.selected)) select(cameras.length === 1 ? cameras[0].split("/") : null);
}

function showFollowing() {
  element("follow").checked = street.following;
  element("whom").hidden = !street.following || state.selected !== null;
}

// What of the page takes the server's time is asked for only where it can be had, and is looked at.
function showObjects() {
  const shown = state.isLive && element("objects").checked;
  objects.show(shown);
  if (state.isLive) send({ objects: shown });
}

function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  const parts = header.part_bytes.map((bytes) => {
    offset += bytes;
    return new Uint8Array(buffer, offset - bytes, bytes);
  });
  return [header, parts];
}

const picture = (bytes) => createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
const key = (header) => `${header.vehicle}/${header.camera}`;

const handlers = {
  connection(header) { say(header.state, header.detail); },
  fields(header) {
    const names = header.fields.map((f) => `${f.tile}: ${f.primitives.toLocaleString()} ` +
      (f.spz_bytes ? "splats" : `parameters (${f.kind}, not drawn)`));
    const notes = header.notes.map((n) => `${n.tile}: ${n.text}`);
    element("fields").textContent = [...names, ...notes].join("; ");
    street.setFields(header.fields);
  },
  async picture(header, parts) {
    const bitmap = await picture(parts[0]);
    header.age_ms += header.held_ms;
    state.pictures += 1;
    if (!header.truth) {
      element("plots").hidden = false;  // a drive has no uplink
      state.ages.push(Date.now() - header.capture_time_ms);
      if (state.ages.length > AGES_KEPT) state.ages.shift();
    }
    street.setPicture(key(header), header, bitmap);
    wall.setPicture(key(header), header, bitmap);
    selectOnly();
    plots.add(header);
  },
  async comparison(header, parts) {
    const [shown, render, difference] = await Promise.all(parts.map(picture));
    wall.setQuality(key(header), header);
    inspector.show(key(header), header, { shown, render, difference });
  },
  abilities(header) {
    state.isLive = header.live;
    for (const control of document.querySelectorAll(".of-server")) control.hidden = !header.live;
    showObjects();
    live.again();
  },
  tiles({ rows }) { showTiles(element("tiles"), rows); },
  objects(header) { if (element("objects").checked) objects.set(header); },
  async view(header, parts) {
    const answer = live.arrive();
    await live.show(answer, header, await picture(parts[0]), parts[1]);
  },
  view_refused(header) { live.refuse(header.problem); },
  departure(header) {
    street.remove(key(header));
    wall.remove(key(header));
    selectOnly();
  },
};

function say(status, detail) {
  const shown = element("connection");
  shown.dataset.state = status;
  shown.textContent = `${status}: ${detail}`;
}

function connect() {
  const socket = new WebSocket(`ws${location.protocol.slice(4)}//${location.host}/socket`);
  socket.binaryType = "arraybuffer";
  state.socket = socket;
  socket.onopen = () => send({ select: state.compared });
  socket.onmessage = ({ data }) => {
    const [header, parts] = decode(data);
    handlers[header.kind]?.(header, parts);  // kinds of a newer server are passed over
  };
  socket.onclose = () => {
    say("closed", "rfedge twin does not answer; trying again");
    setTimeout(connect, RECONNECT_MS);
  };
}

setInterval(() => {
  const drawing = street.isTooSlow ? `${(street.drawingMs / 1000).toFixed(0)} s a drawing`
    : `${street.framesPerSecond()} frames/s`;
  element("rate").textContent = `${state.pictures} pictures/s, ${drawing}`;
  element("slow").hidden = !street.isTooSlow;
  state.pictures = 0;
  wall.showAges();
  plots.draw();
}, 1000);
element("overview").onclick = () => street.overview();
element("follow").onchange = ({ target }) => street.setFollowing(target.checked);
street.onFollowing = showFollowing;
element("objects").onchange = showObjects;
element("look").onclick = () => live.open();
connect();

// For tests and for the console: look from a pose, read the picture, read what was measured.
window.twin = { state, street, select, live, objects };
