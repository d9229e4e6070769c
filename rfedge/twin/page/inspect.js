// One camera in full: what was reconstructed on the left of the slider, the field's render or their
// difference on the right. All three are of the same moment.
export class Inspector {
  constructor(dialog, closed) {
    this.dialog = dialog;
    this.key = null;
    this.pictures = null;
    const find = (id) => document.getElementById(id);
    this.canvas = find("inspect-canvas");
    this.slider = find("inspect-slider");
    this.name = find("inspect-name");
    this.quality = find("inspect-quality");
    this.slider.oninput = () => this.draw();
    for (const choice of dialog.querySelectorAll("input[name=right]"))
      choice.onchange = () => this.draw();
    find("inspect-close").onclick = () => dialog.close();
    dialog.onclose = () => { this.key = null; closed(); };
  }

  open(camera) {
    this.key = camera.join("/");
    this.pictures = null;
    this.name.textContent = this.key;
    this.quality.textContent = "waiting for a render";
    this.dialog.showModal();
  }

  show(key, header, pictures) {
    if (key !== this.key) return;
    for (const old of Object.values(this.pictures ?? {})) old.close();
    this.pictures = pictures;
    const quality = header.psnr_db === null ? "identical" : `${header.psnr_db.toFixed(2)} dB`;
    this.quality.textContent = `picture ${header.sequence}, field against it ${quality}`;
    this.draw();
  }

  draw() {
    if (!this.pictures) return;
    const { shown } = this.pictures;
    const right = this.pictures[this.dialog.querySelector("input[name=right]:checked").value];
    const { canvas } = this;
    if (canvas.width !== shown.width || canvas.height !== shown.height)
      Object.assign(canvas, { width: shown.width, height: shown.height });
    const context = canvas.getContext("2d");
    const split = Math.round(this.slider.value * shown.width);
    context.drawImage(shown, 0, 0);
    if (split < shown.width)
      context.drawImage(right, split, 0, shown.width - split, shown.height,
        split, 0, shown.width - split, shown.height);
    context.fillStyle = "#f0883e";
    context.fillRect(split - 1, 0, 2, shown.height);
  }
}
