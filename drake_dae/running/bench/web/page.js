/* The loop runs in this page, as WebAssembly. */
async function makeEngine() {
  const { create } = await load(Uint8Array.from(atob(wasm), (letter) => letter.charCodeAt(0)));
  const loop = create("loop");
  let tick = 0;

  function sample() {
    const desired = loop.outputs[data.desired], place = loop.outputs.change?.[1];
    const shown = Array.from(loop.view("shown", 0, sizes.scene + sizes.coordinates));
    return {
      time: loop.time,
      z: data.plotted.flatMap((name) => Array.from(loop.outputs[name])),
      r: data.outputs.map((output) => (data.desired ? desired[output.desired] : null)),
      scene: shown.slice(0, sizes.scene),
      coordinates: shown.slice(sizes.scene),
      place,
      phase: data.phase_names[place] ?? "",
    };
  }
  return {
    async start() {
      loop.reset();
      tick = 0;
      loop.show();
      return sample();
    },
    set(input, value) {
      for (const place of data.places[input]) loop.view("parameters", place, 1)[0] = value;
    },
    /* Samples after each of some ticks. */
    async advance(ticks) {
      const found = [];
      for (let i = 0; i < ticks; i++) {
        loop.advance(data.start + (tick + 1) * data.tick);
        tick++;
        found.push(sample());
      }
      return found;
    },
  };
}
