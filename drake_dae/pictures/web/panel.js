/* The sliders. Each sets numbers of the loop by set(input, value, kind). */
const GROUPS = [
  ["reference", "References", true],
  ["surface", "Surfaces", false],
  ["signal", "Signals that the task waits for", true],
  ["plant", "Plant", true],
  ["pole", "Law", true],
];

function make(tag, properties = {}, ...inside) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...inside);
  return made;
}

class Panel {
  constructor(place, set) {
    [this.set_input, this.rows] = [set, []];
    this.knows = make("input", { type: "checkbox" });
    this.knows.addEventListener("change", () => {
      data.controls.forEach(({ kind }, i) => kind === "plant" && this.set(i, this.value(i)));
    });
    for (const [kind, title, open] of GROUPS) {
      const rows = data.controls.flatMap((control, i) => (control.kind === kind ? [this.row(control, i)] : []));
      if (kind === "plant" && data.controls.some(({ known }) => known.length)) {
        const title = "The model of the law has the same numbers.";
        rows.unshift(make("label", { className: "check", title }, this.knows, "the law knows it"));
      }
      if (rows.length) place.append(make("details", { open }, make("summary", {}, title), ...rows));
    }
    const balls = [data.targets.some(({ axes }) => axes.length) && "the green ball (target)",
      data.surfaces.length && "the orange one (surface)"].filter(Boolean);
    const hints = [balls.length && `Drag ${balls.join(" or ")}.`,
      data.bodies.some(({ name }) => name in data.pushes) && "Pull a link to push it.",
      data.bodies.length && "Drag elsewhere to turn the view."];
    place.append(...[...data.notes, hints.filter(Boolean).join(" ")].map((text) => make("p", {}, text)));
  }
  row(control, i) {
    const title = `${control.label}${control.kind === "reference" ? ", change" : ""}`;
    const step = control.kind === "signal" ? 1 : "any";
    const slider = make("input", { type: "range", min: control.low, max: control.high, step, ariaLabel: title });
    slider.dataset.control = control.label;
    slider.addEventListener("input", () => this.set(i, Number(slider.value)));
    this.rows[i] = { slider, shown: make("output"), value: control.value };
    return make("label", {}, make("span", {}, title), this.rows[i].shown, slider);
  }
  value(i) {
    return this.rows[i].value;
  }
  set(i, wanted) {
    const { low, high, rate } = data.controls[i];
    this.show(i, Math.min(Math.max(wanted, low), high));
    if (!rate) this.pass(i);
  }
  show(i, value) {
    const { slider, shown } = this.rows[i];
    slider.value = this.rows[i].value = value;
    shown.textContent = slider.ariaValueText = `${short(value)} ${data.controls[i].unit}`;
  }
  /* Moves what has a limited speed for a time in s; whether there was any. */
  moves(seconds) {
    let found = false;
    data.controls.forEach(({ rate, inputs: [input] }, i) => {
      const off = rate ? this.value(i) - this.present[input] : 0;
      if (!off) return;
      const step = Math.sign(off) * Math.min(Math.abs(off), rate * seconds);
      this.give(input, step === off ? this.value(i) : this.present[input] + step, "surface");
      found = true;
    });
    return found;
  }
  pass(i) {
    const { inputs, factors, powers, known, kind, value: first } = data.controls[i], value = this.value(i);
    inputs.forEach((input, k) => {
      this.give(input, factors.length ? factors[k] * Math.abs(value) ** powers[k] : value, kind);
    });
    for (const input of known) this.give(input, this.knows.checked ? value : first, "known");
  }
  give(input, value, kind) {
    if (this.present[input] === value) return;
    this.present[input] = value;
    this.set_input(input, value, kind);
  }
  /* As at the start. */
  reset() {
    this.present = [...data.inputs];
    this.knows.checked = false;
    data.controls.forEach(({ value }, i) => this.show(i, value));
  }
}
