// Things that the vehicles see and the field does not have: boxes in the street, a list beside it.
import * as THREE from "three";

const COLOUR = 0xd29922;
const MOST_DEPTH_M = 2;  // how far a thing reaches behind the side that is seen, nobody knows
const MOVES_MPS = 0.5;
const SURE = 0.5;  // of confidence; less is shown dimmer

const metres = (value) => `${value.toFixed(1)} m`;
const speed = ({ velocity_mps: [x, y, z] }) => Math.hypot(x, y, z);

// A box that stands on z = 0, turned as ``upright`` says: from axes with z up to the field's.
function box(object, upright) {
  const depth = Math.min(object.width_m, MOST_DEPTH_M);
  const solid = new THREE.BoxGeometry(object.width_m, depth, object.height_m);
  const material = new THREE.LineBasicMaterial({ color: COLOUR, transparent: true,
    opacity: 0.3 + 0.7 * object.confidence });
  const lines = new THREE.LineSegments(new THREE.EdgesGeometry(solid), material);
  solid.dispose();
  lines.position.z = object.height_m / 2;
  const group = new THREE.Group();
  group.quaternion.copy(upright);
  group.add(lines);
  if (speed(object) > MOVES_MPS) {
    const towards = new THREE.Vector3(...object.velocity_mps)
      .applyQuaternion(upright.clone().invert()).normalize();
    lines.rotation.z = Math.atan2(towards.y, towards.x);
    group.add(new THREE.ArrowHelper(towards, new THREE.Vector3(0, 0, 0.1), speed(object), COLOUR));
  }
  return group;
}

function dispose(group) {
  group.traverse((part) => { part.geometry?.dispose(); part.material?.dispose(); });
}

export class StreetObjects {
  constructor(street, section) {
    this.street = street;
    this.section = section;
    this.list = section.querySelector("ul");
    this.status = section.querySelector("p");
    this.fields = new Map();  // what stands on the ground of each field
  }

  set(header) {
    const before = this.fields.get(header.field);
    if (before) this.remove(before);
    if (header.objects.length || header.problem) this.fields.set(header.field, this.added(header));
    else this.fields.delete(header.field);
    this.street.touchLater();
    this.showList();
  }

  added({ origin_m, objects, problem }) {
    const group = new THREE.Group();
    const placed = objects.map((object) => {
      const at = new THREE.Vector3(...object.at_m).add(new THREE.Vector3(...origin_m));
      const shape = box(object, this.street.upright);
      shape.position.copy(at);
      group.add(shape);
      return { object, at };
    });
    this.street.scene.add(group);
    return { group, placed, problem };
  }

  remove({ group }) {
    this.street.scene.remove(group);
    dispose(group);
  }

  show(shown) {
    this.section.hidden = !shown;
    if (shown) return;
    for (const of of this.fields.values()) this.remove(of);
    this.fields.clear();
    this.street.touch();
  }

  showList() {
    const all = [...this.fields.values()];
    const focused = this.list.contains(document.activeElement) && document.activeElement.dataset.id;
    this.list.replaceChildren(...all.flatMap(({ placed }) => placed.map((one) => this.row(one))));
    if (focused) this.list.querySelector(`button[data-id="${focused}"]`)?.focus();
    const problems = all.map(({ problem }) => problem).filter(Boolean);
    this.status.textContent = problems.join("; ") || (this.list.children.length ? "" : "Nothing was seen in the last second.");
  }

  row({ object, at }) {
    const item = document.createElement("li");
    const button = document.createElement("button");
    const detail = document.createElement("small");
    const moves = speed(object) > MOVES_MPS ? `, ${speed(object).toFixed(1)} m/s` : "";
    const unseen = object.unseen_ms > 1000 ? `, last seen ${Math.round(object.unseen_ms / 1000)} s ago` : "";
    button.textContent = `${object.id}: ${metres(object.width_m)} wide, ${metres(object.height_m)} high${moves}`;
    detail.textContent = `at ${at.toArray().map((v) => v.toFixed(1)).join(", ")} m, ` +
      `${Math.round(100 * object.confidence)} % sure${unseen}, by ${object.seen_by.join(", ") || "nobody now"}` +
      (object.doubtful ? "; doubtful: who sees it disagrees with the field in many places" : "");
    Object.assign(button, { title: "Turn the view there", onclick: () => this.street.turnTo(at) });
    button.dataset.id = object.id;
    button.append(detail);
    item.classList.toggle("unsure", object.confidence < SURE || object.doubtful);
    item.append(button);
    return item;
  }
}
