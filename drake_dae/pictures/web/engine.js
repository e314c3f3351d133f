/* The loop runs in this page, as WebAssembly. */
const ENDINGS = ["", "a function has no value: not finite, or singular", "no consistent state is near"];

async function makeEngine() {
  const bytes = Uint8Array.from(atob(code), (letter) => letter.charCodeAt(0));
  const { exports } = (await WebAssembly.instantiate(bytes, {})).instance;
  exports._initialize?.();
  const column = (pointer, size) => new Float64Array(exports.memory.buffer, pointer, size);
  const parameters = column(exports.parameters(), data.inputs.length);
  const row = column(exports.outputs(), data.places.end);
  let tick = 0;

  /* Runs up to a time; the outputs then. */
  function sample(time) {
    const ending = exports.advance(time);
    if (ending) throw new Error(`at t = ${exports.time()} s: ${ENDINGS[ending]}`);
    const { z, r, scene, coordinates, phase, end } = data.places, place = row[phase];
    return {
      time: exports.time(),
      z: z.map((i) => row[i]),
      r: r.map((i) => row[i]),
      scene: Array.from(row.slice(scene, coordinates)),
      coordinates: Array.from(row.slice(coordinates, end)),
      phase: data.phase_names[place] ?? "",
    };
  }
  return {
    start() {
      exports.init();
      tick = 0;
      return sample(data.start);
    },
    set(input, value) {
      parameters[input] = value;
    },
    /* Samples after each of some ticks. */
    advance(ticks) {
      return Array.from({ length: ticks }, () => sample(data.start + ++tick * data.tick - data.early));
    },
  };
}
