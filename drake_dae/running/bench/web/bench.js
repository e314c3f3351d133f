/* The bench: a view in which things are dragged, sliders, and plots of what the engine computes.

   The engine runs the loop: start() gives a sample, advance(ticks) gives one for each tick, and
   set(input, value) changes a number before the next. A sample has the time, outputs z, references
   r, the column of the scene, and the coordinates of the error. */
const element = (id) => document.getElementById(`bench-${id}`);
if (typeof viewer === "undefined") {
  element("state").textContent = "this browser has no WebGL, which the view needs";
  element("state").className = "wrong";
}
const sizes = {
  scene: 12 * data.bodies.length + 9 * data.constraints.length + 12 * data.surfaces.length +
    3 * data.targets.length,
  coordinates: data.prediction ? data.prediction.size : 0,
};
const RATES = [0.1, 0.25, 0.5, 1, 2];
const RESTARTS = ["pole", "known", "parameter", "released"];
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
const bench = (window.bench = {
  data, engine, panel, view, samples: [], isRunning: true, rate: 3, restarts: true, off: 0, speed: 1, failure: "",
});

/* What follows from a sample: error, and the predicted one. */
function taken(sample) {
  sample.error = sample.z.map((z, i) => (z === null || sample.r[i] === null ? null : z - sample.r[i]));
  if (prediction) {
    if (bench.restarts) {
      prediction.restart(sample);
      [bench.restarts, bench.off] = [false, 0];
    }
    sample.predicted = prediction.at(sample.time);
    bench.off = Math.max(bench.off, ...sample.error.map((e, i) => Math.abs(e - sample.predicted[i])));
  }
  bench.samples.push(sample);
  const first = sample.time - SECONDS - 1;
  while (bench.samples[0].time < first) bench.samples.shift();
}

/* The push that the pointer makes now; null ends it. */
function pushed(push) {
  if (!push && bench.push) give(bench.push.name, [0, 0, 0, 0, 0, 0], "released");
  bench.push = push;
  view.push.visible = Boolean(push);
}
function give(name, values, kind) {
  values.forEach((value, k) => panel.give(data.pushes[name].input + k, value, kind));
}
function follow_push() {
  const { point, force, moment } = wrench(bench.push);
  give(bench.push.name, [...force.toArray(), ...moment.toArray()], "push");
  const size = force.length();
  if (!size) return;
  view.push.position.copy(point);
  view.push.setDirection(force.clone().normalize());
  view.push.setLength((FULL * data.size * size) / data.pushes[bench.push.name].most, 0.05 * data.size, 0.03 * data.size);
}

/* Runs some ticks, with the push of the pointer as it is now. */
async function advance(ticks) {
  if (bench.failure) return;
  if (bench.push) follow_push();
  /* What moves at a limited speed has a new place at each tick. */
  for (; panel.moves(data.tick) && ticks > 1; ticks--) await one(1);
  await one(ticks);
}
async function one(ticks) {
  if (bench.failure) return;
  try {
    (await engine.advance(ticks)).forEach(taken);
  } catch (error) {
    [bench.isRunning, bench.failure] = [false, error.message];
  }
  bench.fresh = true;
}

function draw() {
  const last = bench.samples.at(-1);
  view.show(last);
  const chosen = Number(element("signal").value);
  const desired = { value: ({ r }) => r[chosen], color: DESIRED, dashed: true };
  plots.signal.draw(bench.samples, [
    { value: ({ z }) => z[chosen], color: COLORS[1] }, ...(data.desired ? [desired] : []),
  ], data.desired ? [["actual", COLORS[1], false], ["desired", DESIRED, true]] : []);
  const errors = element("error").value.split(",").map(Number);
  if (data.desired) draw_errors(errors);
  else plots.error.draw(bench.samples, errors.map((i) => ({ value: ({ z }) => z[i], color: COLORS[0] })), []);
  const slow = bench.isRunning && bench.speed < 0.95 ? `, runs at ${bench.speed.toFixed(2)} of that` : "";
  const rate = RATES[bench.rate] === 1 ? "real time" : `${RATES[bench.rate]} x real time`;
  element("clock").textContent = `t = ${last.time.toFixed(2)} s, ${rate}${slow}` +
    (last.phase ? `, ${last.phase}` : "") +
    (prediction ? `; error off prediction by ${bench.off.toExponential(1)}` : "");
  element("state").textContent = bench.failure;
  element("state").className = bench.failure ? "wrong" : "";
  element("run").textContent = bench.isRunning ? "pause" : "run";
}

/* Errors over the predicted ones; they are round-off beside the outputs themselves. */
function draw_errors(chosen) {
  const legend = [["error", COLORS[0], false]];
  if (prediction) legend.push(["predicted", PREDICTED, true]);
  const sizes = bench.samples.flatMap(({ z, r }) => chosen.flatMap((i) => [z[i], r[i]]));
  plots.error.draw(bench.samples, chosen.flatMap((i, k) => [
    { value: ({ error }) => error[i], color: COLORS[k % COLORS.length] },
    ...(prediction ? [{ value: ({ predicted }) => predicted[i], color: PREDICTED, dashed: true }] : []),
  ]), legend, sizes.reduce((most, size) => Math.max(most, Math.abs(size ?? 0)), 0));
}

let before = performance.now(), owed = 0, isBusy = false;
async function picture(now) {
  requestAnimationFrame(picture);
  if (isBusy || !bench.samples.length) return;
  const passed = (now - before) / 1000;
  before = now;
  if (bench.isRunning) {
    const wanted = passed * RATES[bench.rate];
    owed = Math.min(owed + wanted, MOST);
    const ticks = Math.floor(owed / data.tick);
    if (ticks) {
      isBusy = true;
      await advance(ticks);
      isBusy = false;
    }
    owed -= ticks * data.tick;
    /* Over about a second: what was done of what the clock asked for. */
    bench.asked = 0.98 * (bench.asked ?? 0) + wanted;
    bench.done = 0.98 * (bench.done ?? 0) + ticks * data.tick;
    bench.speed = bench.asked > 0.2 ? bench.done / bench.asked : 1;
  }
  if (bench.fresh) {
    bench.fresh = false;
    draw();
  }
  view.place_labels(bench.samples.at(-1));
}

async function restart() {
  panel.reset();
  pushed(null);
  Object.assign(bench, { samples: [], restarts: true, failure: "", isRunning: true, fresh: true });
  taken(await engine.start());
}
const change_rate = (by) => {
  bench.rate = Math.min(Math.max(bench.rate + by, 0), RATES.length - 1);
  bench.fresh = true;
};
const act = {
  run: () => (bench.isRunning = !bench.isRunning && !bench.failure, bench.fresh = true),
  step: () => (bench.isRunning = false, bench.failure || advance(1)),
  slower: () => change_rate(-1),
  faster: () => change_rate(1),
  restart,
};
for (const [name, action] of Object.entries(act)) element(name).addEventListener("click", action);

element("title").textContent = data.title;
data.outputs.forEach(({ name, unit }, i) => element("signal").append(new Option(unit ? `${name} [${unit}]` : name, i)));
const units = data.desired ? [...new Set(data.outputs.map(({ unit }) => unit))] : [];
for (const unit of units) {
  const own = data.outputs.flatMap((output, i) => (output.unit === unit ? [i] : []));
  element("error").append(new Option(`errors${unit ? ` [${unit}]` : " without unit"}`, own.join()));
}
data.outputs.forEach(({ name, unit }, i) => {
  const text = data.desired ? `error of ${name}` : unit ? `${name} [${unit}]` : name;
  element("error").append(new Option(text, i));
});
const force = data.outputs.findIndex(({ unit }) => unit === "N");
element("signal").value = Math.max(force, 0);
if (!data.desired) {
  element("error").value = data.outputs.length > 1 ? (force === 1 ? 0 : 1) : 0;
  element("error").setAttribute("aria-label", "second output to plot");
}
document.body.classList.toggle("bench-without-view", !data.bodies.length && !data.constraints.length);
for (const name of ["signal", "error"]) element(name).addEventListener("change", () => (bench.fresh = true));
viewer.gui.domElement.style.display = "none";
new Drag(view, panel, pushed);
await restart();
Object.assign(bench, { advance, draw, isReady: true });
requestAnimationFrame(picture);
