/* What is dragged in the view: a green ball is the target, an orange one a surface, a link is pushed. */
const NEAR = 24; /* pixels from a ball at which it is taken */
const FULL = 0.4; /* a pull by this share of the robot's size is the strongest push */

class Drag {
  constructor(view, panel, pushed) {
    [this.view, this.panel, this.pushed] = [view, panel, pushed];
    this.ray = new three.Raycaster();
    const canvas = viewer.renderer.domElement;
    this.canvas = canvas;
    canvas.addEventListener("pointerdown", (event) => this.begin(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.move(event), { capture: true });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.end(event), { capture: true });
    }
  }
  aim({ clientX, clientY }) {
    const box = viewer.renderer.domElement.getBoundingClientRect();
    const at = new three.Vector2(2 * (clientX - box.left) / box.width - 1, 1 - 2 * (clientY - box.top) / box.height);
    viewer.camera.updateMatrixWorld();
    viewer.scene.updateMatrixWorld();
    this.ray.setFromCamera(at, viewer.camera);
    this.line = this.ray.ray.clone().applyMatrix4(viewer.scene.matrixWorld.clone().invert());
  }
  begin(event) {
    this.aim(event);
    this.held = this.ball(event) ?? this.link();
    if (!this.held) return; /* The camera turns. */
    this.swallow(event);
    this.canvas.style.cursor = "grabbing";
    viewer.controls.enabled = false;
    event.target.setPointerCapture?.(event.pointerId);
    const origin = new three.Vector3(), ahead = viewer.camera.getWorldDirection(new three.Vector3());
    ahead.copy(inside(ahead).sub(inside(origin)));
    const { across } = this.held; /* In a plane that is seen from its edge nothing is aimed at. */
    const normal = across && Math.abs(across.dot(ahead)) > 0.15 ? across : ahead;
    this.plane = new three.Plane().setFromNormalAndCoplanarPoint(normal, this.held.point);
  }
  move(event) {
    if (!this.held) {
      if (event.buttons) return; /* The camera turns. */
      this.aim(event);
      this.canvas.style.cursor = this.ball(event) || this.link() ? "grab" : "";
      return;
    }
    this.swallow(event);
    this.aim(event);
    const { along, point } = this.held;
    const pointer = this.line.intersectPlane(this.plane, new three.Vector3());
    if (!pointer) return;
    if (along) this.nearest(point, along, pointer);
    this.held.follow(pointer);
  }
  end(event) {
    if (!this.held) return;
    this.swallow(event);
    this.held.release?.();
    this.held = undefined;
    this.canvas.style.cursor = "grab";
    viewer.controls.enabled = true;
  }
  swallow(event) {
    event.stopPropagation();
    event.preventDefault();
  }
  /* The point of a line that is nearest to the pointer's ray; a line toward the eye is not followed. */
  nearest(point, along, pointer) {
    const { origin, direction } = this.line;
    const away = point.clone().sub(origin), cosine = along.dot(direction);
    const slope = 1 - cosine * cosine;
    if (slope > 0.05) {
      const length = (cosine * direction.dot(away) - along.dot(away)) / slope;
      pointer.copy(point).addScaledVector(along, length);
    } else {
      pointer.copy(point).addScaledVector(along, along.dot(pointer.clone().sub(point)));
    }
  }
  ball({ clientX, clientY }) {
    const found = [];
    const offer = (handle, make) => {
      const place = handle.visible && this.view.on_screen(handle.position);
      const off = place ? Math.hypot(place[0] - clientX, place[1] - clientY) : Infinity;
      if (off < NEAR) found.push([off, make]);
    };
    const unit = (axis) => new three.Vector3().setComponent(axis, 1);
    data.targets.forEach(({ axes }, k) => {
      const others = [0, 1, 2].filter((axis) => !axes.some(([own]) => own === axis));
      const along = axes.length === 1 ? unit(axes[0][0]) : undefined;
      const across = others.length === 1 ? unit(others[0]) : undefined;
      offer(this.view.targets[k], () => this.mover(this.view.targets[k], axes, along, across));
    });
    data.surfaces.forEach(({ controls, direction }, k) => {
      const axes = controls.map((control, axis) => [axis, control]).filter(([, control]) => control !== null);
      const along = direction && new three.Vector3(...direction);
      offer(this.view.surfaces[k], () => this.mover(this.view.surfaces[k], axes, along));
    });
    return found.sort((one, other) => one[0] - other[0])[0]?.[1]();
  }
  /* Moves controls, one for each of some axes of the world, as far as the pointer. */
  mover(handle, axes, along, across) {
    const point = handle.position.clone();
    const before = axes.map(([, control]) => this.panel.value(control));
    const follow = (pointer) => axes.forEach(([axis, control], i) => {
      const off = pointer.getComponent(axis) - point.getComponent(axis);
      this.panel.set(control, before[i] + off);
    });
    return { point, along, across, follow };
  }
  /* A push on the link under the pointer, which pulls the point that was taken. */
  link() {
    for (const hit of this.ray.intersectObjects(data.bodies.map(({ path }) => node(path)), true)) {
      const number = data.bodies.findIndex(({ path }) => {
        for (let one = hit.object; one; one = one.parent) if (one === node(path)) return true;
        return false;
      });
      const { name, path } = data.bodies[number];
      if (!(name in data.pushes)) return undefined;
      const local = node(path).worldToLocal(hit.point.clone());
      const point = inside(hit.point), push = { name, path, local, pointer: point.clone() };
      return {
        point,
        follow: (pointer) => (this.pushed(push), push.pointer.copy(pointer)),
        release: () => this.pushed(null),
      };
    }
    return undefined;
  }
}

/* Force and moment of a push about the origin of its link's frame, in the world. */
function wrench({ name, path, local, pointer }) {
  const frame = node(path);
  frame.updateWorldMatrix(true, false);
  const point = inside(frame.localToWorld(local.clone()));
  const { most } = data.pushes[name];
  const force = pointer.clone().sub(point).multiplyScalar(most / (FULL * data.size));
  force.clampLength(0, most);
  const origin = inside(new three.Vector3().setFromMatrixPosition(frame.matrixWorld));
  const lever = point.clone().sub(origin);
  return { point, force, moment: lever.cross(force) };
}
