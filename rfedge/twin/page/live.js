// The street as it is now from where the user looks: the field with the newest pictures of all vehicles
// carried to that view. The server is asked again whenever the user moves, and as long as this is open.
const MOVED_EVERY_MS = 250;  // how often it is looked whether the user moved; the server is asked no more often
const SIZE = { width_px: 640, height_px: 360 };
const FRESHNESS_OPACITY = 0.5;
const OLDEST_MS = 2000;  // older pictures vouch for nothing

const seconds = (ms) => `${(ms / 1000).toFixed(1)} s`;
const percent = (share) => `${Math.round(100 * share)} %`;

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Green where a pixel is new, red where it is as old as can be, grey where no picture vouches for it.
function colours(freshness, { width_px, height_px, step_ms, field_alone }) {
  const image = new ImageData(width_px, height_px);
  const table = new Uint8ClampedArray(4 * 256);
  for (let step = 0; step < 256; ++step) {
    const share = Math.min(1, (step * step_ms) / OLDEST_MS);
    const colour = step === field_alone ? [0x48, 0x4f, 0x58]
      : [255 * Math.min(1, 2 * share) * 0.8, 255 * Math.min(1, 2 - 2 * share) * 0.75, 40];
    table.set([...colour, 255 * FRESHNESS_OPACITY * (step === field_alone ? 1.5 : 1)], 4 * step);
  }
  freshness.forEach((step, i) => image.data.set(table.subarray(4 * step, 4 * step + 4), 4 * i));
  return image;
}

function sources(cameras) {
  const seen = cameras.filter((camera) => camera.share > 0)
    .map((c) => `${c.vehicle}/${c.camera} ${percent(c.share)}, ${seconds(c.age_ms)} old`);
  const outvoted = cameras.filter((camera) => camera.outvoted)
    .map((c) => `${c.vehicle}/${c.camera} left out: it disagrees with the field`);
  return [...seen, ...outvoted].join("; ");
}

// Why no pixel of a view is live.
function why(cameras) {
  if (!cameras.length) return ": no camera near has sent a picture lately; follow one";
  const youngest_ms = Math.min(...cameras.map((camera) => camera.age_ms));
  if (youngest_ms > OLDEST_MS) return `: the newest picture is ${seconds(youngest_ms)} old`;
  return ": no camera sees what is seen from here; follow one";
}

export class LiveView {
  constructor(panel, street, send) {
    const find = (id) => document.getElementById(id);
    this.panel = panel;
    this.street = street;
    this.send = send;
    this.canvas = find("live-canvas");
    this.state = find("live-state");
    this.legend = find("live-legend");
    find("live-oldest").textContent = seconds(OLDEST_MS);
    this.choice = find("live-freshness");
    this.overlay = document.createElement("canvas");
    this.picture = null;
    this.shown = 0;  // views, since the page was opened
    this.arrived = this.latest = 0;  // answers of the server, and which of them is shown
    this.asked = null;
    this.choice.onchange = () => this.draw();
    find("live-close").onclick = () => this.close();
    document.addEventListener("keydown", ({ key }) => { if (key === "Escape") this.close(); });
  }

  get isOpen() { return !this.panel.hidden; }

  open() {
    this.panel.hidden = false;
    this.say("asking the server", false);
    this.asked = null;
    this.follow();
    clearInterval(this.timer);
    this.timer = setInterval(() => this.follow(), MOVED_EVERY_MS);
  }

  close() {
    if (!this.isOpen) return;
    clearInterval(this.timer);
    this.panel.hidden = true;
    this.send(null);
  }

  // Ask for another viewpoint where the user has moved.
  follow() {
    const place = this.street.viewpoint(SIZE);
    const wanted = JSON.stringify(place);
    if (wanted === this.asked) return;
    this.asked = wanted;
    place ? this.send(place) : this.say("no field is there to look at", true);
  }

  // The connection came back: nobody knows what was asked for before.
  again() {
    if (!this.isOpen) return;
    this.asked = null;
    this.follow();
  }

  // The number of an answer, taken when it arrives: pictures take long to decode, a refusal does not.
  arrive() { return ++this.arrived; }

  async show(answer, header, bitmap, deflated) {
    const freshness = await inflated(deflated);
    if (!this.isOpen || answer < this.latest) {
      bitmap.close();
      return;
    }
    this.latest = answer;
    this.picture?.bitmap.close();
    this.picture = { header, bitmap, freshness };
    this.shown += 1;
    const live = `${percent(header.live_share)} live${header.live_share > 0 ? "" : why(header.cameras)}`;
    this.say([live, sources(header.cameras)].filter(Boolean).join("; "), false);
    this.draw();
  }

  refuse(problem) {
    this.latest = this.arrive();
    this.say(problem, true);
  }

  say(text, isRefused) {
    this.state.textContent = text;
    this.panel.classList.toggle("refused", isRefused);
  }

  draw() {
    this.legend.hidden = !this.choice.checked;
    if (!this.picture) return;
    const { header, bitmap, freshness } = this.picture;
    const size = { width: header.width_px, height: header.height_px };
    if (this.canvas.width !== size.width || this.canvas.height !== size.height)
      Object.assign(this.canvas, size);
    const context = this.canvas.getContext("2d");
    context.drawImage(bitmap, 0, 0);
    if (!this.choice.checked) return;
    Object.assign(this.overlay, size);
    this.overlay.getContext("2d").putImageData(colours(freshness, header), 0, 0);
    context.drawImage(this.overlay, 0, 0);
  }
}
