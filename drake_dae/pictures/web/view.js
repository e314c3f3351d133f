/* The robot, on the viewer of Meshcat: bodies, forces and surfaces follow a sample. */
const three = MeshCat.THREE;
const node = (path) => viewer.scene_tree.find(path).object;
/* A point of the robot's world, as a copy; Meshcat turns that world in the one of three.js. */
const inside = (point) => viewer.scene.worldToLocal(point.clone());
const outside = (point) => viewer.scene.localToWorld(point.clone());
const vector = (column, first) => new three.Vector3(...column.slice(first, first + 3));

class View {
  constructor() {
    this.largest = { force: 1e-6, moment: 1e-6 };
    this.labels = data.constraints.map(() => this.label());
    this.targets = data.targets.map(() => this.handle(0x1a9933));
    this.surfaces = data.surfaces.map(() => this.handle(0xe08a00));
    this.push_label = this.label();
    this.push_label.style.color = "#8833bb";
    this.push = new three.ArrowHelper(new three.Vector3(0, 0, 1), new three.Vector3(), 1, 0x8833bb);
    viewer.scene.add(this.push);
    this.show_push(null);
    new ResizeObserver(() => {
      viewer.set_3d_pane_size();
      /* The camera is placed for a pane of 4 to 3. A narrower pane shows as much of the robot. One
         sixth remains free, since the robot moves and is dragged. */
      const { camera, dom_element: pane } = viewer;
      camera.zoom = 0.83 * Math.min(1, (0.7 * pane.clientWidth) / Math.max(pane.clientHeight, 1));
      camera.updateProjectionMatrix();
      viewer.set_dirty();
    }).observe(viewer.dom_element);
  }
  /* The arrow of a push, with its force; without a point there is none. */
  show_push(point, force, most) {
    const size = point ? force.length() : 0;
    this.push.visible = size > 0;
    this.push_label.textContent = `${size.toPrecision(3)} N`;
    if (!size) return;
    this.push.position.copy(point);
    this.push.setDirection(force.clone().normalize());
    this.push.setLength((FULL * data.size * size) / most, 0.05 * data.size, 0.03 * data.size);
  }
  label() {
    return document.body.appendChild(make("div", { className: "bench-label" }));
  }
  /* A ball that is dragged; it is seen through what is before it. */
  handle(color) {
    const form = new three.SphereGeometry(0.022 * data.size, 20, 14);
    const look = new three.MeshBasicMaterial({ color, transparent: true, opacity: 0.8, depthTest: false });
    const made = new three.Mesh(form, look);
    made.renderOrder = 2;
    viewer.scene.add(made);
    return made;
  }
  /* Where each part of the scene's column begins. */
  static places() {
    const bodies = 12 * data.bodies.length, n = 3 * data.constraints.length;
    const surfaces = bodies + 3 * n;
    return { points: bodies, forces: bodies + n, moments: bodies + 2 * n, surfaces,
      targets: surfaces + 12 * data.surfaces.length };
  }
  pose(column, first) {
    const [a, b, c, d, e, f, g, h, i, x, y, z] = column.slice(first, first + 12);
    return [a, b, c, 0, d, e, f, 0, g, h, i, 0, x, y, z, 1];
  }
  show({ scene, r }) {
    const at = View.places();
    data.bodies.forEach(({ path }, k) => viewer.set_transform(path, this.pose(scene, 12 * k)));
    data.surfaces.forEach(({ path }, k) => {
      viewer.set_transform(path, this.pose(scene, at.surfaces + 12 * k));
      const has = data.surfaces[k].controls.some((control) => control !== null);
      this.surfaces[k].visible = has;
      this.surfaces[k].position.copy(this.besides(scene, at.surfaces + 12 * k + 9, k));
    });
    data.targets.forEach(({ outputs, axes }, k) => {
      const place = vector(scene, at.targets + 3 * k);
      for (const [axis, output] of outputs) place.setComponent(axis, r[output]);
      this.targets[k].visible = axes.length > 0;
      this.targets[k].position.copy(place);
    });
    data.constraints.forEach(({ force, moment }, k) => {
      const point = vector(scene, at.points + 3 * k);
      this.arrow(force, point, vector(scene, at.forces + 3 * k), "force");
      if (moment) this.arrow(moment, point, vector(scene, at.moments + 3 * k), "moment");
    });
    viewer.set_dirty();
  }
  /* A handle of a surface stands beside the contact point of the surface, if it has one. */
  besides(scene, first, k) {
    const row = data.constraints.findIndex(({ name }) => name === data.surfaces[k].name);
    const place = vector(scene, first);
    if (row < 0) return place;
    const point = vector(scene, View.places().points + 3 * row);
    const normal = new three.Vector3(...(data.surfaces[k].direction ?? [0, 0, 1]));
    const up = new three.Vector3(0.3, 0.5, Math.abs(normal.z) < 0.7 ? 1 : 0).projectOnPlane(normal);
    return point.addScaledVector(up.normalize(), 0.25 * data.size);
  }
  arrow(path, point, force, kind) {
    const size = force.length();
    this.largest[kind] = Math.max(this.largest[kind], size);
    const along = size > 0 ? force.clone().divideScalar(size) : new three.Vector3(0, 0, 1);
    const turned = new three.Quaternion().setFromUnitVectors(new three.Vector3(0, 0, 1), along);
    const pose = new three.Matrix4().compose(point, turned, new three.Vector3(1, 1, 1));
    viewer.set_transform(path, pose.toArray());
    node([...path, "arrow"]).scale.setScalar(Math.max(size / this.largest[kind], 1e-3));
  }
  /* Where a point of the scene is on the screen, in pixels of the window; null behind the camera. */
  on_screen(point) {
    const box = viewer.renderer.domElement.getBoundingClientRect();
    viewer.camera.updateMatrixWorld();
    const { x, y, z } = outside(point).project(viewer.camera);
    if (z > 1) return null;
    return [box.left + (0.5 + 0.5 * x) * box.width, box.top + (0.5 - 0.5 * y) * box.height];
  }
  /* In each picture, since the camera turns while the robot stands still. */
  place_labels({ scene }) {
    const held = this.push.visible && this.on_screen(this.push.position);
    this.push_label.style.display = held ? "block" : "none";
    if (held) Object.assign(this.push_label.style, { left: `${held[0] + 14}px`, top: `${held[1] + 14}px` });
    const at = View.places(), taken = [], box = viewer.renderer.domElement.getBoundingClientRect();
    data.constraints.forEach(({ name, force }, k) => {
      const size = vector(scene, at.forces + 3 * k).length();
      const label = this.labels[k];
      const head = node([...force, "arrow", "head"]).getWorldPosition(new three.Vector3());
      const place = size && this.on_screen(inside(head));
      label.style.display = place ? "block" : "none";
      if (!place) return;
      label.textContent = `${data.constraints.length > 1 ? `${name} ` : ""}${size.toPrecision(3)} N`;
      /* Beyond the head, as seen from the point of application, so that it covers no tool. */
      const foot = this.on_screen(vector(scene, at.points + 3 * k)) ?? place;
      let left = place[0] < foot[0] ? place[0] - label.offsetWidth - 12 : place[0] + 12;
      let top = place[1] + (place[1] < foot[1] ? -30 : 10);
      const lowest = box.bottom - label.offsetHeight;
      left = Math.min(Math.max(left, box.left), box.right - label.offsetWidth - 2);
      top = Math.min(Math.max(top, box.top), lowest);
      const covers = ([x, y]) => Math.abs(x - left) < 120 && Math.abs(y - top) < 18;
      const step = top + 18 * data.constraints.length > lowest ? -18 : 18;
      while (taken.some(covers)) top += step;
      taken.push([left, top]);
      label.style.left = `${left}px`;
      label.style.top = `${top}px`;
    });
  }
}
