// The street in three dimensions: splats of every tile, cameras as frusta with their pictures.
// World axes are the field's, in metres; the field says which way is up. OpenCV cameras look along
// +z with y down, three's along -z with y up: half a turn around x apart.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

const NEAR_M = 0.05, FAR_M = 5000, FRUSTUM_M = 1.5;
const PICTURES_EVERY_MS = 100;  // drawing splats costs far more than a picture is worth
const DRAWING_SHARE = 0.2;  // of the time at most, for pictures alone
const SLOW_MS = 400, QUICK_MS = 40, COARSEST = 0.25;  // fewer pixels while a drawing takes longer
const TOO_SLOW_MS = 1000;  // without a GPU a drawing takes seconds, in which the whole page stands still
const HALF_TURN = new THREE.Quaternion(1, 0, 0, 0);
const Z = new THREE.Vector3(0, 0, 1);
const BACK_M = 20;  // how far an overview steps back, in a field as large as a street

const vector = (m) => new THREE.Vector3(m[0], m[1], m[2]);
const threeRotation = ([w, x, y, z]) => new THREE.Quaternion(x, y, z, w).multiply(HALF_TURN);

export class Street {
  constructor(parent) {
    this.parent = parent;
    this.following = false;
    this.onFollowing = () => {};
    this.upright = new THREE.Quaternion();  // from axes with z up to the field's
    this.cameras = new Map();
    this.tiles = new Map();
    this.selected = null;
    this.frames = 0;
    this.drawn = 0;  // since the page was opened
    this.drawingMs = 0;  // what the last drawing took, until the GPU was done
    this.resolution = 1;  // pixels drawn for one of the page, in each direction
    this.renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
    const canvas = this.renderer.domElement;
    Object.assign(canvas, { tabIndex: 0, title: "Drag, scroll, or arrow keys" });
    canvas.setAttribute("aria-label", "The street; arrow keys move the view");
    parent.prepend(canvas);
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0x0d1117);
    this.scene.add(new SparkRenderer({ renderer: this.renderer, onDirty: () => this.touch() }));
    this.view = new THREE.PerspectiveCamera(60, 1, NEAR_M, FAR_M);
    this.view.position.set(-20, -20, 15);
    this.setUp([0, 0, 1]);
    new ResizeObserver(() => this.resize()).observe(parent);
    this.renderer.setAnimationLoop(() => this.draw());
  }

  // OrbitControls takes the vertical when they are made.
  setUp(up) {
    const { domElement: canvas } = this.renderer;
    const target = this.controls?.target ?? new THREE.Vector3();
    this.controls?.dispose();
    this.view.up.copy(vector(up)).normalize();
    this.upright.setFromUnitVectors(Z, this.view.up);
    this.controls = new OrbitControls(this.view, canvas);
    this.controls.target.copy(target);
    this.controls.addEventListener("change", () => this.touch());
    this.controls.listenToKeyEvents(canvas);
  }

  setFollowing(following) {
    this.following = following;
    this.onFollowing(following);
    this.touch();
  }

  resize() {
    if (this.fixedSize) return;
    const { clientWidth, clientHeight } = this.parent;
    const size = [clientWidth, clientHeight, this.resolution].join();
    if (size === this.size) return;
    this.size = size;
    this.renderer.setPixelRatio(this.resolution);
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.view.aspect = clientWidth / Math.max(1, clientHeight);
    this.view.updateProjectionMatrix();
    this.touch();
  }

  // The next frame shows something new: at once, or when a picture is worth a drawing.
  touch() { this.changed = true; }
  touchLater() { this.pictureChanged = true; }

  draw() {
    const now = performance.now();
    const camera = this.following && this.cameras.get(this.selected);
    if (camera) this.lookAlong(camera);
    else if (!this.fixedSize) this.controls.update();
    if (this.isDrawing(now)) return;
    const everyMs = Math.max(PICTURES_EVERY_MS, this.drawingMs / DRAWING_SHARE);
    const isDue = this.pictureChanged && !this.isTooSlow && now - (this.drawnAt ?? -everyMs) >= everyMs;
    if (!this.changed && !isDue) return;
    this.changed = this.pictureChanged = false;
    this.drawnAt = now;
    this.renderer.render(this.scene, this.view);
    const gl = this.renderer.getContext();
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.frames += 1;
    this.drawn += 1;
  }

  // Whether the GPU is still at the last drawing; when it is done, its time sets the next one's pixels.
  isDrawing(now) {
    if (!this.fence) return false;
    const gl = this.renderer.getContext();
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    gl.deleteSync(this.fence);
    this.fence = null;
    this.drawingMs = now - this.drawnAt;
    if (this.fixedSize) return false;
    if (this.drawingMs > SLOW_MS && this.resolution > COARSEST) this.setResolution(this.resolution / 2);
    else if (this.drawingMs < QUICK_MS && this.resolution < 1) this.setResolution(2 * this.resolution);
    return false;
  }

  setResolution(resolution) {
    this.resolution = resolution;
    this.resize();
  }

  // Then it is drawn for a new view alone, and pictures show on the wall.
  get isTooSlow() { return this.drawingMs > TOO_SLOW_MS; }

  framesPerSecond() {
    const frames = this.frames;
    this.frames = 0;
    return frames;
  }

  setFields(fields) {
    const wanted = new Set(fields.map((field) => field.field));
    const gone = [...this.tiles].filter(([id]) => !wanted.has(id));
    for (const [id] of gone) this.tiles.delete(id);
    const stale = new Map(gone.map(([, tile]) => [tile.field.tile, tile]));
    for (const field of fields) {
      if (this.tiles.has(field.field) || !field.spz_bytes) continue;
      const mesh = new SplatMesh({ url: `/splats/${field.field}.spz` });
      mesh.position.copy(vector(field.origin_m));
      const tile = { mesh, field, loaded: false, before: stale.get(field.tile) };
      stale.delete(field.tile);
      mesh.initialized.then(() => {
        tile.loaded = true;
        this.discard(tile.before);  // shown until now, so that nothing flickers
        tile.before = null;
      });
      this.tiles.set(field.field, tile);
      this.scene.add(mesh);
      if (!this.seenField) this.start(field);
      this.seenField = true;
    }
    for (const tile of stale.values()) this.discard(tile);
  }

  discard(tile) {
    for (let one = tile; one; one = one.before) {
      this.scene.remove(one.mesh);
      one.mesh.dispose?.();
    }
    this.touch();
  }

  // Where a camera stood that the field was trained on, or all of it.
  start(field) {
    this.setUp(field.up);
    if (!field.start) { this.overview(); return; }
    const eye = vector(field.start.eye_m).add(vector(field.origin_m));
    this.lookFrom(eye, vector(field.start.towards).multiplyScalar(this.backM() / 2).add(eye));
  }

  lookFrom(eye, target) {
    this.setFollowing(false);
    this.view.position.copy(eye);
    this.controls.target.copy(target);
  }

  // Half of the way between cameras of a field, where that is smaller than a street.
  backM() {
    const apart = Math.max(...[...this.tiles.values()].map(({ field }) => field.apart_m));
    return apart > 0 ? Math.min(BACK_M, apart / 2) : BACK_M;
  }

  // From behind and above the first camera, or a camera that the field was trained on.
  overview() {
    const box = new THREE.Box3();
    const seen = [...this.cameras.values()].map(({ group }) =>
      [group.position, new THREE.Vector3(0, 0, -1).applyQuaternion(group.quaternion)]);
    for (const { field } of this.tiles.values()) {
      const origin = vector(field.origin_m);
      box.expandByPoint(vector(field.low_m).add(origin));
      box.expandByPoint(vector(field.high_m).add(origin));
      const { start } = field;
      if (start) seen.push([vector(start.eye_m).add(origin), vector(start.towards)]);
    }
    if (box.isEmpty() && !seen.length) return;
    const [middle, ahead] = seen[0] ?? [box.getCenter(new THREE.Vector3()), new THREE.Vector3()];
    const back = this.view.up.clone().multiplyScalar(0.4).addScaledVector(ahead, -0.9);
    this.lookFrom(back.multiplyScalar(this.backM()).add(middle), middle);
  }

  // Where the user looks from, relative to the field whose ground is nearest; null without a field.
  viewpoint({ width_px, height_px }) {
    const fields = [...this.tiles.values()].map(({ field }) => field);
    if (!fields.length) return null;
    const { position } = this.view;
    const distance = (field) => {
      const origin = vector(field.origin_m);
      return new THREE.Box3(vector(field.low_m).add(origin), vector(field.high_m).add(origin))
        .distanceToPoint(position);
    };
    const nearest = fields.reduce((best, field) => (distance(field) < distance(best) ? field : best));
    const { w, x, y, z } = this.view.quaternion.clone().multiply(HALF_TURN).normalize();
    const focal_px = height_px / 2 / Math.tan((Math.PI / 360) * this.view.fov);
    return {
      field: nearest.field,
      translation_m: position.clone().sub(vector(nearest.origin_m)).toArray(),
      rotation_wxyz: [w, x, y, z],
      intrinsics: { width_px, height_px, fx_px: focal_px, fy_px: focal_px,
        cx_px: width_px / 2, cy_px: height_px / 2 },
    };
  }

  turnTo(point) {
    this.setFollowing(false);
    this.controls.target.copy(point);
    this.touch();
  }

  setPicture(key, header, bitmap) {
    let camera = this.cameras.get(key);
    if (camera && camera.size !== `${bitmap.width}x${bitmap.height}`) {
      this.remove(key);
      camera = null;
    }
    const isFirst = !camera && !this.cameras.size;
    if (!camera) this.cameras.set(key, (camera = this.newCamera(header.intrinsics, bitmap)));
    if (camera.texture.image !== bitmap) camera.texture.image.close();
    camera.texture.image = bitmap;
    camera.texture.needsUpdate = true;
    camera.group.visible = header.translation_m !== null;  // a lost vehicle has a picture, no place
    if (camera.group.visible) {
      camera.group.position.copy(vector(header.translation_m)).add(vector(header.origin_m));
      camera.group.quaternion.copy(threeRotation(header.rotation_wxyz));
    }
    camera.intrinsics = header.intrinsics;
    const placed = [...this.tiles.values()];
    if (isFirst && !placed.some(({ field }) => field.start)) this.overview();
    this.touchLater();
  }

  newCamera(k, bitmap) {
    const [w, h] = [(k.width_px / k.fx_px) * FRUSTUM_M, (k.height_px / k.fy_px) * FRUSTUM_M];
    const x = (k.width_px / 2 - k.cx_px) / k.fx_px * FRUSTUM_M;
    const y = -(k.height_px / 2 - k.cy_px) / k.fy_px * FRUSTUM_M;
    const corners = [[-1, 1], [1, 1], [1, -1], [-1, -1]].map(([a, b]) =>
      new THREE.Vector3(x + (a * w) / 2, y + (b * h) / 2, -FRUSTUM_M));
    const lines = corners.flatMap((c, i) => [new THREE.Vector3(), c, c, corners[(i + 1) % 4]]);
    const texture = new THREE.Texture(bitmap);
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.flipY = false;  // an ImageBitmap cannot be flipped when it is uploaded
    texture.repeat.set(1, -1);
    texture.offset.set(0, 1);
    const picture = new THREE.Mesh(new THREE.PlaneGeometry(w, h),
      new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide, toneMapped: false }));
    picture.position.set(x, y, -FRUSTUM_M);
    const material = new THREE.LineBasicMaterial({ color: 0x58a6ff });
    const group = new THREE.Group();
    group.add(picture, new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(lines), material));
    this.scene.add(group);
    return { group, texture, material, intrinsics: k, size: `${bitmap.width}x${bitmap.height}` };
  }

  remove(key) {
    const camera = this.cameras.get(key);
    if (camera) {
      this.scene.remove(camera.group);
      camera.texture.dispose();
      camera.group.traverse((part) => { part.geometry?.dispose(); part.material?.dispose(); });
      this.cameras.delete(key);
    }
    this.touchLater();
  }

  select(key) {
    this.selected = key && key.join("/");
    for (const [name, camera] of this.cameras)
      camera.material.color.set(name === this.selected ? 0xf0883e : 0x58a6ff);
    this.touch();
  }

  lookAlong({ group, intrinsics }) {
    if (!this.view.position.equals(group.position)) this.touch();
    this.view.position.copy(group.position);
    this.view.quaternion.copy(group.quaternion);
    this.controls.target.copy(new THREE.Vector3(0, 0, -5).applyQuaternion(group.quaternion)
      .add(group.position));
    this.setFieldOfView(intrinsics);
  }

  setFieldOfView(k) {
    this.view.fov = (360 / Math.PI) * Math.atan(k.height_px / 2 / k.fy_px);
    this.view.updateProjectionMatrix();
  }

  // Draw splats alone, exactly from a camera's pose at its size, until released with null.
  fix(pose) {
    this.fixedSize = pose !== null;
    for (const { group } of this.cameras.values()) group.visible = !this.fixedSize;
    if (!pose) { this.resize(); return; }
    const { translation_m, rotation_wxyz, intrinsics: k } = pose;
    this.size = null;
    this.renderer.setPixelRatio(1);
    this.renderer.setSize(k.width_px, k.height_px, false);
    this.view.aspect = k.width_px / k.height_px;
    this.view.position.copy(vector(translation_m));
    this.view.quaternion.copy(threeRotation(rotation_wxyz));
    this.setFieldOfView(k);
    this.touch();
  }

  loaded() {
    const tiles = [...this.tiles.values()];
    return tiles.length > 0 && tiles.every((tile) => tile.loaded);
  }

  settled() { return this.loaded() && !this.changed && !this.fence; }

  png() { return this.renderer.domElement.toDataURL("image/png"); }
}
