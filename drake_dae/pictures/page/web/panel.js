/* The sliders. Each sets numbers of the loop by set(input, value). */
const GROUPS = [
  ["reference", "References", true],
  ["surface", "Surfaces", false],
  ["signal", "Signals that the task waits for", true],
  ["plant", "Plant", true],
  ["pole", "Law", true],
];

class Panel {
  constructor(place, set) {
    [this.place, this.input, this.present] = [place, set, data.inputs.map(({ value }) => value)];
    this.rows = [];
    this.knows = this.check("the law knows it", "The model of the law has the same numbers.");
    for (const [kind, title, isOpen] of GROUPS) this.group(kind, title, isOpen);
    this.rest();
    for (const note of data.notes) this.note(note);
    const balls = [data.targets.some(({ axes }) => axes.length) && "the green ball (target)",
      data.surfaces.length && "the orange one (surface)"].filter(Boolean);
    const says = [balls.length && `drag ${balls.join(" or ")}`,
      data.bodies.some(({ name }) => name in data.pushes) && "pull a link to push it", data.bodies.length && "drag elsewhere to turn the view"];
    const said = says.filter(Boolean).join("; ");
    if (said) this.note(`${said[0].toUpperCase()}${said.slice(1)}.`);
  }
  group(kind, title, isOpen) {
    const chosen = data.controls.map((control, i) => [control, i])
      .filter(([control]) => control.kind === kind);
    if (!chosen.length) return;
    const folder = document.createElement("details");
    folder.open = isOpen;
    const head = document.createElement("summary");
    head.textContent = title;
    folder.append(head);
    if (kind === "plant" && data.controls.some(({ known }) => known.length)) folder.append(this.knows);
    for (const [control, i] of chosen) folder.append(this.row(control, i));
    this.place.append(folder);
  }
  row(control, i) {
    const label = document.createElement("label"), name = document.createElement("span");
    const slider = document.createElement("input"), shown = document.createElement("output");
    name.textContent = `${control.label}${control.kind === "reference" ? ", change" : ""}`;
    const step = control.kind === "signal" ? 1 : "any";
    Object.assign(slider, { type: "range", min: control.low, max: control.high, step });
    slider.dataset.control = control.label;
    slider.ariaLabel = name.textContent; // The label's first control is the output.
    slider.addEventListener("input", () => this.set(i, Number(slider.value)));
    label.append(name, shown, slider);
    this.rows[i] = { slider, shown, value: control.value };
    this.show(i);
    return label;
  }
  check(text, title) {
    const label = document.createElement("label"), box = document.createElement("input");
    label.className = "check";
    label.title = title;
    box.type = "checkbox";
    box.addEventListener("change", () => {
      data.controls.forEach(({ kind }, i) => kind === "plant" && this.rows[i] && this.set(i, this.value(i)));
    });
    label.append(box, document.createTextNode(text));
    return label;
  }
  note(text) {
    const line = document.createElement("p");
    line.textContent = text;
    this.place.append(line);
  }
  /* Any other number, by its name. */
  rest() {
    const folder = document.createElement("details"), head = document.createElement("summary");
    const select = document.createElement("select"), number = document.createElement("input");
    const unit = document.createElement("output"), row = document.createElement("label");
    head.textContent = "All parameters";
    number.type = "number";
    number.step = "any";
    [select.ariaLabel, number.ariaLabel] = ["parameter", "value of the parameter"];
    data.inputs.forEach(({ name }, i) => select.append(new Option(name, i)));
    const show = () => {
      number.value = this.present[select.value];
      unit.textContent = data.inputs[select.value].unit;
    };
    select.addEventListener("change", show);
    folder.addEventListener("toggle", show);
    number.addEventListener("change", () => {
      if (number.value !== "" && Number.isFinite(number.valueAsNumber)) {
        this.give(Number(select.value), number.valueAsNumber, "parameter");
      }
    });
    row.append(number, unit);
    folder.append(head, select, row);
    this.place.append(folder);
    this.refresh = show;
  }
  value(i) {
    return this.rows[i].value;
  }
  set(i, wanted) {
    const control = data.controls[i], row = this.rows[i];
    row.value = Math.min(Math.max(wanted, control.low), control.high);
    this.show(i);
    if (!control.rate) this.pass(i);
  }
  /* Moves what has a limited speed for a time in s; whether there was any. */
  moves(seconds) {
    let found = false;
    data.controls.forEach(({ rate, inputs: [input] }, i) => {
      const off = rate ? this.rows[i].value - this.present[input] : 0;
      if (!off) return;
      const step = Math.sign(off) * Math.min(Math.abs(off), rate * seconds);
      this.give(input, step === off ? this.rows[i].value : this.present[input] + step, "surface");
      found = true;
    });
    return found;
  }
  pass(i) {
    const control = data.controls[i], row = this.rows[i];
    control.inputs.forEach((input, k) => {
      const { factors, powers } = control;
      const value = factors.length ? factors[k] * Math.abs(row.value) ** powers[k] : row.value;
      this.give(input, value, control.kind);
    });
    const known = this.knows.querySelector("input").checked ? row.value : control.value;
    for (const input of control.known) this.give(input, known, "known");
  }
  give(input, value, kind) {
    if (this.present[input] === value) return;
    this.present[input] = value;
    this.input(input, value, kind);
  }
  show(i) {
    const { slider, shown, value } = this.rows[i];
    slider.value = value;
    shown.textContent = slider.ariaValueText = `${short(value)} ${data.controls[i].unit}`;
  }
  /* As at the start. */
  reset() {
    this.present = data.inputs.map(({ value }) => value);
    this.knows.querySelector("input").checked = false;
    data.controls.forEach(({ value }, i) => {
      this.rows[i].value = value;
      this.show(i);
    });
    this.refresh();
  }
}
