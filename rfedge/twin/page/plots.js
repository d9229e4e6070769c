// The last minutes of all cameras together: bits a second by what they were predicted from, and age.
import uPlot from "uplot";

const SECONDS = 180, WIDTH_PX = 364, HEIGHT_PX = 110;
const KINDS = [
  ["temporal", "#58a6ff", (refs) => refs.some((r) => r === "warp" || r === "previous")],
  ["render only", "#3fb950", (refs) => refs.length > 0],
  ["intra", "#f85149", () => true],
];

const axis = { font: "10px system-ui", size: 34, stroke: "#8b949e", grid: { stroke: "#21262d" }, ticks: { show: false } };
const options = (title, series) => ({
  title, width: WIDTH_PX, height: HEIGHT_PX, cursor: { show: false }, legend: { live: false },
  axes: [{ ...axis, values: (_, ticks) => ticks.map((s) => `${s} s`) }, axis],
  scales: { x: { time: false }, y: { range: (_, low, high) => [0, Math.max(1, high)] } },
  series: [{}, ...series.map((one) => ({ points: { show: false }, ...one }))],
});

export class Plots {
  constructor(parent) {
    this.second = this.empty();
    this.history = [];
    const bits = KINDS.map(([label, stroke]) => ({ label, stroke, fill: `${stroke}33` }));
    this.bits = new uPlot(options("uplink, kbit/s", bits), [[], ...KINDS.map(() => [])], parent);
    const ages = [{ label: "median", stroke: "#58a6ff" }, { label: "oldest", stroke: "#f0883e" }];
    this.ages = new uPlot(options("age when shown, ms", ages), [[], [], []], parent);
  }

  empty() { return { bits: KINDS.map(() => 0), ages: [] }; }

  add(header) {
    if (header.truth) return;
    const kind = KINDS.findIndex(([, , holds]) => holds(header.references));
    this.second.bits[kind] += (8 * header.payload_bytes) / 1000;
    this.second.ages.push(header.age_ms);
  }

  draw() {
    const ages = this.second.ages.sort((a, b) => a - b);
    this.history.push({
      bits: this.second.bits,
      ages: [ages[ages.length >> 1] ?? null, ages.at(-1) ?? null],
    });
    this.second = this.empty();
    if (this.history.length > SECONDS) this.history.shift();
    const x = this.history.map((_, i) => i - this.history.length + 1);
    this.bits.setData([x, ...KINDS.map((_, k) => this.history.map(({ bits }) => bits[k]))]);
    this.ages.setData([x, ...[0, 1].map((k) => this.history.map(({ ages }) => ages[k]))]);
  }
}
