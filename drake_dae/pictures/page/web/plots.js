/* Curves over the last seconds on a canvas. */
const SECONDS = 8;
const ROUND_OFF = 1e-12; /* Less than this part of what is compared is no error of a loop. */
/* Readers who see red or green less distinguish them, too; each has a contrast of 3 or more to white. */
const COLORS = ["#1a5fb4", "#c01c28", "#1f9eb5", "#f86000", "#210300", "#b1005d"];

class Plot {
  constructor(canvas) {
    this.canvas = canvas;
  }
  /* curves: [{ value: sample -> number, color, dashed, name }]; of errors the numbers of the outputs,
     beside whose size they may be round-off. */
  draw(samples, curves, unit, errors = []) {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    if (samples.length < 2) return;
    const columns = curves.map(({ value }) => samples.map(value));
    let [low, high] = [Infinity, -Infinity];
    for (const value of columns.flat()) {
      if (value === null || !Number.isFinite(value)) continue;
      [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (low > high) return;
    const least = Math.max(1e-12, 1e-3 * Math.max(Math.abs(low), Math.abs(high)));
    const compared = errors.flatMap((i) => samples.flatMap(({ z, r }) => [z[i], r[i]]));
    const rounds = ROUND_OFF * compared.reduce((most, x) => Math.max(most, Math.abs(x)), 0);
    const is_round_off = Math.max(Math.abs(low), Math.abs(high)) <= rounds;
    if (high - low < least) [low, high] = [low - least, high + least];
    if (is_round_off) [low, high] = [-rounds, rounds];
    const [left, right, top, bottom] = [58, width - 8, 30, height - 18];
    const last = samples.at(-1).time, first = Math.max(samples[0].time, last - SECONDS);
    const span = Math.max(last - first, 1e-3);
    const x = (time) => left + ((right - left) * (time - first)) / span;
    const y = (value) => bottom - ((bottom - top) * (value - low)) / (high - low);
    pen.font = "11px sans-serif";
    pen.fillStyle = "#667";
    pen.strokeStyle = "#e2e2e8";
    pen.lineWidth = 1;
    pen.textAlign = "right";
    for (const part of [0, 0.5, 1]) {
      const between = low + part * (high - low);
      const value = Math.abs(between) < 1e-3 * (high - low) ? 0 : between;
      pen.beginPath();
      pen.moveTo(left, y(value));
      pen.lineTo(right, y(value));
      pen.stroke();
      pen.fillText(tick(value, high - low), left - 4, y(value) + 4);
    }
    pen.textAlign = "center";
    for (let t = Math.ceil(first); t <= last; t++) pen.fillText(`${t} s`, x(t), height - 5);
    pen.textAlign = "left";
    pen.fillText(unit && `[${unit}]`, 6, 14);
    let place = unit ? 18 + pen.measureText(`[${unit}]`).width : 6;
    for (const { name: text, color, dashed } of curves.filter(({ name }) => name)) {
      pen.fillStyle = pen.strokeStyle = color;
      pen.fillText(text, place, 14);
      pen.setLineDash(dashed ? [5, 4] : []);
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(place, 20);
      pen.lineTo(place + pen.measureText(text).width, 20);
      pen.stroke();
      place += pen.measureText(text).width + 12;
    }
    curves.forEach(({ color, dashed }, i) => {
      pen.strokeStyle = color;
      pen.setLineDash(dashed ? [6, 5] : []);
      pen.lineWidth = dashed ? 2.2 : 1.6;
      pen.beginPath();
      samples.forEach(({ time }, k) => {
        if (time >= first && columns[i][k] !== null) pen.lineTo(x(time), y(columns[i][k]));
      });
      pen.stroke();
    });
    pen.setLineDash([]);
    if (is_round_off) {
      pen.fillStyle = "#667";
      pen.fillText(`round-off: below ${ROUND_OFF} of the outputs`, left + 4, bottom - 4);
    }
  }
}

/* A number at an axis of some length: with digits that tell it from its neighbours. */
function tick(value, length) {
  const size = Math.abs(value);
  if (!size || size < 1e-3 || size >= 1e4) return short(value);
  const digits = Math.min(Math.max(3, 2 + Math.ceil(Math.log10(size / length))), 9);
  return String(Number(value.toPrecision(digits)));
}

/* A number with three digits. */
function short(value) {
  const size = Math.abs(value);
  if (size && (size < 1e-3 || size >= 1e4)) return value.toExponential(1);
  return String(Number(value.toPrecision(3)));
}
