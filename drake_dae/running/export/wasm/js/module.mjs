/* $title in a page or in Node: written by drake_dae $version.

     import { load } from "./$name.mjs";
     const { create } = await load();
     const $first = create("$first");
     $example

   `parts` lists the names and units in `parameters`, `inputs` and `outputs`. Vectors are
   Float64Arrays in the memory of the module, which are valid until the next `create`. $name.wasm
   computes everything and has no imports. */

/* Kind of a part -> names, units and defaults. */
export const parts = $parts;

const reasons = ["", "a function has no value: not finite, or singular", "no consistent state is near"];
const statuses = ["running", "holding", "stopped", "waiting"];
const faults = ["", "number", "stale", "late", "clock", "value"];

/* Loads the module.

   source: its bytes, a Response, or its address; by default the address beside this file. */
export async function load(source = new URL("./$name.wasm", import.meta.url)) {
  const { instance } = await WebAssembly.instantiate(await bytes(source), {});
  instance.exports._initialize?.();
  return { parts, create: (kind) => create(instance.exports, kind) };
}

async function bytes(source) {
  if (source instanceof ArrayBuffer || ArrayBuffer.isView(source)) return source;
  if (typeof Response !== "undefined" && source instanceof Response) return source.arrayBuffer();
  const url = new URL(source, import.meta.url);
  if (url.protocol === "file:") {
    const { readFile } = await import("node:fs/promises");
    return readFile(url);
  }
  const response = await fetch(url);
  if (!response.ok) throw new Error(`$${url}: $${response.status} $${response.statusText}`);
  return response.arrayBuffer();
}

function create(code, kind) {
  if (!Object.hasOwn(parts, kind)) {
    throw new Error(`there is no part '$${kind}': $${Object.keys(parts).join(", ")}`);
  }
  const pointer = code[`$${kind}_create`]();
  if (!pointer) throw new Error("there is no memory left");
  return new (kind === "controller" ? Controller : Integrated)(code, kind, pointer);
}

/* The common members of all parts. */
class Part {
  constructor(code, kind, pointer) {
    this.call = (name, ...values) => code[`$${kind}_$${name}`](pointer, ...values);
    this.view = (name, first, size) =>
      new Float64Array(code.memory.buffer, this.call(name) + 8 * first, size);
    const { parameters, inputs, outputs } = parts[kind];
    this.parameters = {};
    parameters.forEach(({ name }, i) => this.number(this.parameters, name, "parameters", i));
    this.inputs = this.vectors("inputs", inputs);
    this.outputs = this.vectors("outputs", outputs);
    Object.freeze(this.parameters);
  }
  /* Sets the default values and the initial state. */
  reset() {
    this.call("reset");
  }
  number(owner, key, name, index) {
    Object.defineProperty(owner, key, {
      enumerable: true,
      get: () => this.view(name, index, 1)[0],
      set: (value) => {
        if (typeof value !== "number") throw new TypeError(`$${key} is a number, got $${value}`);
        this.view(name, index, 1)[0] = value;
      },
    });
  }
  vectors(name, signals) {
    const properties = {};
    let end = 0;
    for (const [key, { length }] of Object.entries(signals)) {
      const first = end;
      end += length;
      Object.defineProperty(properties, key, {
        enumerable: true,
        get: () => this.view(name, first, length),
        set: (values) => {
          if (values?.length !== length) {
            throw new RangeError(`$${key} has $${length} numbers, got $${values?.length}`);
          }
          this.view(name, first, length).set(values);
        },
      });
    }
    return Object.freeze(properties);
  }
}

/* A plant or a loop: `step(dt)` or `advance(time)`, then `outputs`; `state` may be changed. */
class Integrated extends Part {
  constructor(code, kind, pointer) {
    super(code, kind, pointer);
    this.kind = kind;
    this.number(this, "longest", "longest", 0); /* step, in s */
  }
  get time() {
    return this.call("time");
  }
  get state() {
    return this.view("state", 0, parts[this.kind].state.length);
  }
  step(dt) {
    this.advance(this.time + dt);
  }
  advance(time) {
    this.check(this.call("advance", time));
  }
  /* Computes the outputs again, for example after a change of the state or of the inputs. */
  show() {
    this.check(this.call("show"));
  }
  check(status) {
    if (status) throw new Error(`$${this.kind} at t = $${this.time} s: $${reasons[status]}`);
  }
}

/* A controller: `step(time)` reads `inputs` and writes `outputs`; it returns the status. */
class Controller extends Part {
  constructor(code, kind, pointer) {
    super(code, kind, pointer);
    this.number(this, "stop_time", "stop_time", 0);
    this.number(this, "max_age", "max_age", 0);
  }
  step(time, measured_at = time) {
    return statuses[this.call("step", time, measured_at)];
  }
  get fault() {
    return faults[this.call("fault")];
  }
  get stop_control() {
    return this.view("stop_control", 0, parts.controller.outputs.control.length);
  }
  set patience(steps) {
    this.call("patience", steps);
  }
}
