// All cameras as a wall of pictures: age, bits, how the pose and the time of capture were come by,
// quality of the field at that pose. Those of a vehicle stand together; one that is behind its rig's
// newest instant says by how many.
const KEPT_MS = 2000;
const LATE_MS = 2000;  // no picture for so long: its age is what matters
const CLOCKS = {
  sender_report: ["RTCP time", "time of capture from the camera's RTCP sender reports"],
  arrival: ["arrival time", "time of capture taken from the stream's arrival at the vehicle"],
};
const STATES = {
  lost: ["lost", "the vehicle does not know where its camera is", "bad"],
  localising: ["localising", "the vehicle looks for its camera in the field", "fair"],
  tracking: ["tracking", "the pose was found in the field", "good"],
};

const age = (ms) => (ms < 10000 ? `${Math.round(ms)} ms` : `${Math.round(ms / 1000)} s`);

function badge(text, title, kind = "") {
  const made = document.createElement("span");
  Object.assign(made, { className: `badge ${kind}`, textContent: text, title });
  return made;
}

// What is known of a picture beside its pixels, as badges.
function badges({ header, psnr_db }) {
  if (header.truth) return [badge("drive", "a picture of the drive; nothing is sent now")];
  const state = STATES[header.localisation] ?? (header.translation_m === null ? STATES.lost
    : ["pose given", "the pose is the dataset's or the sensors'"]);
  const clock = CLOCKS[header.clock];
  const field = header.translation_m !== null && psnr_db !== null
    ? [badge(`field ${psnr_db.toFixed(1)} dB`, "PSNR of the field's render against this picture")]
    : [];
  return [badge(...state), ...(clock ? [badge(...clock)] : []), ...field];
}

export class Wall {
  constructor(parent, choose) {
    this.parent = parent;
    this.choose = choose;
    this.cameras = new Map();
    this.empty = document.createElement("p");
    this.empty.textContent = "No camera is seen.";
    parent.append(this.empty);
  }

  setPicture(key, header, bitmap) {
    const camera = this.cameras.get(key) ?? this.add(key, [header.vehicle, header.camera]);
    Object.assign(camera, { header, arrived: performance.now() });
    camera.sizes.push([camera.arrived, header.payload_bytes]);
    if (camera.canvas.width !== bitmap.width || camera.canvas.height !== bitmap.height)
      Object.assign(camera.canvas, { width: bitmap.width, height: bitmap.height });
    camera.canvas.getContext("2d").drawImage(bitmap, 0, 0);
    camera.canvas.dataset.sequence = header.sequence;
    camera.canvas.dataset.instant = header.instant;
  }

  add(key, name) {
    const figure = document.createElement("figure");
    const canvas = document.createElement("canvas");
    const caption = document.createElement("figcaption");
    const detail = document.createElement("small");
    const state = document.createElement("div");
    caption.append(key, detail, state);
    figure.append(canvas, caption);
    figure.dataset.camera = key;
    figure.onclick = () => this.choose(name);
    const beside = this.ofVehicle(name[0]).at(-1);
    beside ? beside.figure.after(figure) : this.parent.append(figure);
    this.empty.hidden = true;
    const camera = { vehicle: name[0], figure, canvas, detail, state, sizes: [], psnr_db: null,
      seen_db: new Map() };
    this.cameras.set(key, camera);
    return camera;
  }

  ofVehicle(vehicle) {
    return [...this.cameras.values()].filter((camera) => camera.vehicle === vehicle);
  }

  setQuality(key, header) {
    const camera = this.cameras.get(key);
    if (!camera) return;
    camera.psnr_db = header.psnr_db;
    if (header.name && header.psnr_db !== null) camera.seen_db.set(header.name, header.psnr_db);
  }

  showAges() {
    const now = performance.now();
    for (const camera of this.cameras.values()) {
      const { header, arrived } = camera;
      camera.sizes = camera.sizes.filter(([at]) => now - at < KEPT_MS);
      const bytes = camera.sizes.reduce((sum, [, size]) => sum + size, 0);
      const age_ms = header.age_ms + now - arrived;
      const rate = `${Math.round((8 * bytes) / KEPT_MS)} kbit/s`;
      const decoding = `${Math.round(header.decoding_ms)} ms after its last byte`;
      const facts = header.truth ? this.ofField(camera)
        : `age ${age(age_ms)}, decoded ${decoding}, ${rate}`;
      camera.figure.classList.toggle("late", !header.truth && age_ms > LATE_MS);
      camera.state.replaceChildren(...badges(camera));
      const mates = this.ofVehicle(camera.vehicle);
      const behind = Math.max(...mates.map((mate) => mate.header.instant)) - header.instant;
      const together = header.instant && behind > 1 ? `, ${behind} instants behind` : "";
      camera.detail.textContent = facts + together;
    }
  }

  // The held-out error: of this picture, and the mean of those seen.
  ofField({ psnr_db, seen_db }) {
    if (psnr_db === null) return "not compared yet";
    const mean = [...seen_db.values()].reduce((sum, db) => sum + db, 0) / seen_db.size;
    return `field ${psnr_db.toFixed(1)} dB here, ${mean.toFixed(2)} dB over ${seen_db.size}`;
  }

  select(chosen) {
    const name = chosen && chosen.join("/");
    for (const [key, { figure }] of this.cameras)
      figure.classList.toggle("selected", key === name);
  }

  remove(key) {
    this.cameras.get(key)?.figure.remove();
    this.cameras.delete(key);
    this.empty.hidden = this.cameras.size > 0;
  }
}
