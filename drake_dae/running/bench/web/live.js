/* The loop runs in the process that serves this page; it advances as the page asks. */
async function makeEngine() {
  let changes = [];

  async function ask(what, told = null) {
    let answer;
    try {
      answer = await fetch(what, { method: "POST", body: JSON.stringify(told) });
    } catch {
      throw new Error("the bench has ended: there is no answer from drake-dae");
    }
    const found = await answer.json();
    if (found.error) throw new Error(found.error);
    return found;
  }
  return {
    async start() {
      changes = [];
      return (await ask("start")).samples[0];
    },
    set(input, value) {
      changes.push([input, value]);
    },
    async advance(ticks) {
      const set = changes;
      changes = [];
      return (await ask("advance", { ticks, set })).samples;
    },
    async save() {
      return (await ask("save")).saved;
    },
  };
}
