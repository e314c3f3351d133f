/* The bench: a view in which things are dragged, sliders, and plots of what the engine computes.

   The engine runs the loop: start() gives a sample, advance(ticks) gives one for each tick, and
   set(input, value) changes a number before the next. A sample has the time, outputs z, references
   r, the column of the scene, and the coordinates of the error. */
const element = (id) => document.getElementById(`bench-${id}`);
if (typeof viewer === "undefined") {
  element("state").textContent = "this browser has no WebGL, which the view needs";
  element("state").className = "wrong";
}
const RATES = [0.1, 0.25, 0.5, 1, 2];
const RESTARTS = ["pole", "known", "released"];
const [DESIRED, PREDICTED] = ["#1a9933", "#e08a00"];
const MOST = 0.1; /* s of the clock that are made up for in one picture */

const engine = await makeEngine();
const view = new View();
const panel = new Panel(element("panel"), (input, value, kind) => {
  engine.set(input, value);
  if (RESTARTS.includes(kind)) bench.restarts = true;
});
const prediction = data.prediction && new Prediction(data.prediction, (input) => panel.present[input]);
const plots = { signal: new Plot(element("signal-plot")), error: new Plot(element("error-plot")) };
const unitOf = (i) => data.outputs[i].unit;
const units = [...new Set(data.outputs.map(({ unit }) => unit))];
const bench = (window.bench = {
  data, panel, view, samples: [], isRunning: true, rate: 3, restarts: true, off: 0, offs: {}, speed: 1, failure: "",
});

/* What follows from a sample: error, and the predicted one. */
function take(sample) {
  sample.error = sample.z.map((z, i) => z - sample.r[i]);
  if (prediction) {
    if (bench.restarts) {
      prediction.restart(sample);
      Object.assign(bench, { restarts: false, off: 0, offs: {} });
    }
    sample.predicted = prediction.at(sample.time);
    sample.error.forEach((error, i) => {
      const off = Math.abs(error - sample.predicted[i]);
      bench.offs[unitOf(i)] = Math.max(bench.offs[unitOf(i)] ?? 0, off);
      bench.off = Math.max(bench.off, off);
    });
  }
  bench.samples.push(sample);
  while (bench.samples[0].time < sample.time - SECONDS - 1) bench.samples.shift();
}

/* The push that the pointer makes now; null ends it. */
function pushed(push) {
  if (!push && bench.push) give(bench.push.name, [0, 0, 0, 0, 0, 0], "released");
  bench.push = push;
  view.show_push(null);
}
function give(name, values, kind) {
  values.forEach((value, k) => panel.give(data.pushes[name].input + k, value, kind));
}
function follow_push() {
  const { point, force, moment } = wrench(bench.push);
  give(bench.push.name, [...force.toArray(), ...moment.toArray()], "push");
  view.show_push(point, force, data.pushes[bench.push.name].most);
}

/* Runs some ticks, with the push of the pointer as it is now. */
function advance(ticks) {
  if (bench.failure) return;
  if (bench.push) follow_push();
  try {
    /* What moves at a limited speed has a new place at each tick. */
    for (; panel.moves(data.tick) && ticks > 1; ticks--) engine.advance(1).forEach(take);
    engine.advance(ticks).forEach(take);
  } catch (error) {
    [bench.isRunning, bench.failure] = [false, error.message];
  }
  bench.fresh = true;
}

function draw() {
  const last = bench.samples.at(-1), chosen = Number(element("signal").value);
  const errors = element("error").value.split(",").map(Number);
  view.show(last);
  const actual = { value: ({ z }) => z[chosen], color: COLORS[1], name: "actual" };
  const desired = { value: ({ r }) => r[chosen], color: DESIRED, dashed: true, name: "desired" };
  plots.signal.draw(bench.samples, [actual, desired], unitOf(chosen), []);
  plots.error.draw(bench.samples, errors.flatMap((i, k) => {
    const color = COLORS[k % COLORS.length];
    const own = { value: ({ error }) => error[i], color, name: k ? "" : "error" };
    const dashed = { color: PREDICTED, dashed: true, name: k ? "" : "predicted" };
    return prediction ? [own, { ...dashed, value: ({ predicted }) => predicted[i] }] : [own];
  }), unitOf(errors[0]), errors);
  const slow = bench.isRunning && bench.speed < 0.95 ? `, runs at ${bench.speed.toFixed(2)} of that` : "";
  const rate = RATES[bench.rate] === 1 ? "real time" : `${RATES[bench.rate]} x real time`;
  const offs = Object.entries(bench.offs).map(([unit, off]) => `${off.toExponential(1)} ${unit}`.trim());
  element("clock").textContent = `t = ${last.time.toFixed(2)} s, ${rate}${slow}` +
    (last.phase ? `, ${last.phase}` : "") + (prediction ? `; error off prediction by ${offs.join(", ")}` : "");
  element("state").textContent = bench.failure;
  element("state").className = bench.failure ? "wrong" : "";
  element("run").textContent = bench.isRunning ? "pause" : "run";
}

let before = performance.now(), owed = 0, asked = 0, done = 0;
function picture(now) {
  requestAnimationFrame(picture);
  const passed = (now - before) / 1000;
  before = now;
  if (bench.isRunning) {
    const wanted = passed * RATES[bench.rate];
    owed = Math.min(owed + wanted, MOST);
    const ticks = Math.floor(owed / data.tick);
    if (ticks) advance(ticks);
    owed -= ticks * data.tick;
    /* Over about a second: what was done of what the clock asked for. */
    asked = 0.98 * asked + wanted;
    done = 0.98 * done + ticks * data.tick;
    bench.speed = asked > 0.2 ? done / asked : 1;
  }
  if (bench.fresh) draw();
  bench.fresh = false;
  view.place_labels(bench.samples.at(-1));
}

function restart() {
  panel.reset();
  pushed(null);
  Object.assign(bench, { samples: [], restarts: true, failure: "", isRunning: true, fresh: true });
  take(engine.start());
}
const change_rate = (by) => {
  bench.rate = Math.min(Math.max(bench.rate + by, 0), RATES.length - 1);
  bench.fresh = true;
};
const act = {
  run: () => (bench.isRunning = !bench.isRunning && !bench.failure, bench.fresh = true),
  step: () => (bench.isRunning = false, advance(1)),
  slower: () => change_rate(-1),
  faster: () => change_rate(1),
  restart,
};
for (const [name, action] of Object.entries(act)) element(name).addEventListener("click", action);

element("title").textContent = data.title;
const named = ({ name, unit }) => (unit ? `${name} [${unit}]` : name);
data.outputs.forEach((output, i) => element("signal").append(new Option(named(output), i)));
for (const unit of units) {
  const own = data.outputs.flatMap((output, i) => (output.unit === unit ? [i] : []));
  element("error").append(new Option(`errors${unit ? ` [${unit}]` : " without unit"}`, own.join()));
}
data.outputs.forEach((output, i) => {
  element("error").append(new Option(`error of ${named(output)}`, i));
});
element("signal").value = Math.max(data.outputs.findIndex(({ unit }) => unit === "N"), 0);
for (const name of ["signal", "error"]) element(name).addEventListener("change", () => (bench.fresh = true));
viewer.gui.domElement.style.display = "none";
new Drag(view, panel, pushed);
restart();
Object.assign(bench, { advance, draw, isReady: true });
requestAnimationFrame(picture);
