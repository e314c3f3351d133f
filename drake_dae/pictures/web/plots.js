/* Curves over the last seconds on a canvas. */
const SECONDS = 8;
const ROUND_OFF = 1e-12; /* Less than this part of what is compared is no error of a loop. */
/* Readers who see red or green less distinguish them, too; each has a contrast of 3 or more to white. */
const COLORS = ["#1a5fb4", "#c01c28", "#1f9eb5", "#f86000", "#210300", "#b1005d"];
const largest = (values) => values.reduce((most, value) => Math.max(most, Math.abs(value)), 0);

class Plot {
  constructor(canvas) {
    this.canvas = canvas;
  }
  line(points, color, width, dash = []) {
    const { pen } = this;
    pen.strokeStyle = color;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.beginPath();
    for (const point of points) pen.lineTo(...point);
    pen.stroke();
  }
  text(words, align, x, y, color = "#667") {
    this.pen.textAlign = align;
    this.pen.fillStyle = color;
    this.pen.fillText(words, x, y);
  }
  /* curves: [{ value: sample -> number, color, dashed, name }]; of errors the numbers of the outputs,
     beside whose size they may be round-off. */
  draw(samples, curves, unit, errors) {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)]; /* It is empty. */
    const pen = (this.pen = canvas.getContext("2d"));
    pen.scale(ratio, ratio);
    pen.font = "11px sans-serif";
    const columns = curves.map(({ value }) => samples.map(value));
    const values = columns.flat().filter(Number.isFinite);
    if (samples.length < 2 || !values.length) return;
    const size = largest(values), least = Math.max(1e-12, 1e-3 * size);
    const rounds = ROUND_OFF * largest(errors.flatMap((i) => samples.flatMap(({ z, r }) => [z[i], r[i]])));
    let low = values.reduce((a, b) => Math.min(a, b)), high = values.reduce((a, b) => Math.max(a, b));
    if (high - low < least) [low, high] = [low - least, high + least];
    if (size <= rounds) [low, high] = [-rounds, rounds];
    const [left, right, top, bottom] = [58, width - 8, 30, height - 18];
    const last = samples.at(-1).time, first = Math.max(samples[0].time, last - SECONDS);
    const span = Math.max(last - first, 1e-3);
    const x = (time) => left + ((right - left) * (time - first)) / span;
    const y = (value) => bottom - ((bottom - top) * (value - low)) / (high - low);
    for (const part of [0, 0.5, 1]) {
      const between = low + part * (high - low);
      const value = Math.abs(between) < 1e-3 * (high - low) ? 0 : between;
      this.line([[left, y(value)], [right, y(value)]], "#e2e2e8", 1);
      this.text(short(value, 5), "right", left - 4, y(value) + 4);
    }
    for (let t = Math.ceil(first); t <= last; t++) this.text(`${t} s`, "center", x(t), height - 5);
    let place = 6;
    for (const { name, color, dashed } of [{ name: unit && `[${unit}]` }, ...curves].filter(({ name }) => name)) {
      const end = place + pen.measureText(name).width;
      this.text(name, "left", place, 14, color);
      if (color) this.line([[place, 20], [end, 20]], color, 2, dashed ? [5, 4] : []);
      place = end + 12;
    }
    curves.forEach(({ color, dashed }, i) => {
      const points = samples.flatMap(({ time }, k) => (time < first ? [] : [[x(time), y(columns[i][k])]]));
      this.line(points, color, dashed ? 2.2 : 1.6, dashed ? [6, 5] : []);
    });
    if (size <= rounds) this.text(`round-off: below ${ROUND_OFF} of the outputs`, "left", left + 4, bottom - 4);
  }
}

/* A number with few digits. */
function short(value, digits = 3) {
  const size = Math.abs(value);
  if (size && (size < 1e-3 || size >= 1e4)) return value.toExponential(1);
  return String(Number(value.toPrecision(digits)));
}
