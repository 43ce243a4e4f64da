// Shows a fit (reports/fit_page.py): some of the arm's configurations, what was measured, its errors.

function showFit(view) {
  const element = (id) => document.getElementById(id);
  element('loading').hidden = true;
  if (!RobotView.hasWebGL()) {
    element('no-webgl').hidden = false;
    element('scene').hidden = true;
    return;
  }
  const picture = new FitPicture(element('scene'), view);
  element('legend').append(...Object.entries(picture.groups).map(([name, group]) => {
    const label = document.createElement('label');
    const box = Object.assign(document.createElement('input'), {type: 'checkbox', checked: true});
    const dot = Object.assign(document.createElement('span'), {className: 'dot'});
    dot.style.background = `var(--${name})`;
    box.addEventListener('change', () => {
      group.visible = box.checked;
      picture.draw();
    });
    label.append(box, dot, view.legend[name]);
    return label;
  }));
}

class FitPicture extends RobotView {
  constructor(place, view) {
    super(place, view.scene);
    this.points = view.points.map((p) => new THREE.Vector3(...p));
    this.groups = {};
    this.spread = new THREE.Box3().setFromPoints(this.points);
    const size = this.spread.getSize(new THREE.Vector3()).length();
    for (const arm of view.arms) {
      const joints = arm.map((p) => new THREE.Vector3(...p));
      joints.forEach((p) => this.spread.expandByPoint(p));
      this._addRods('arm', joints.slice(0, -1), joints.slice(1), 0.006 * size);
    }
    const dots = new THREE.PointsMaterial({size: 3, sizeAttenuation: false});
    this._theme(dots, '--soft');
    this.dots = new THREE.Points(new THREE.BufferGeometry().setFromPoints(this.points), dots);
    this._group('soft').add(this.dots);
    for (const [when, width] of [['before', 0.0014], ['after', 0.002]]) {
      const ends = view.errors[when].map((p) => new THREE.Vector3(...p));
      this._addRods(when, this.points, ends, width * size);
    }
    for (const sensor of view.sensors) {
      const [from, to] = sensor.line.map((p) => new THREE.Vector3(...p));
      const solid = new THREE.MeshPhongMaterial();
      this._theme(solid, '--sight');
      const ball = new THREE.Mesh(new THREE.SphereGeometry(0.015 * size, 24, 16), solid);
      ball.position.copy(to);
      this._group('sight').add(ball);
      if (!from.equals(to)) this._addRods('sight', [from], [to], 0.004 * size);
      this.spread.expandByPoint(from);
      this._addLabel(sensor.text, to);
    }
    // The axes of the robot base.
    const length = 0.12 * size;
    this.world.add(new THREE.AxesHelper(length));
    ['x', 'y', 'z'].forEach((name, i) => this._addLabel(name, new THREE.Vector3().setComponent(i, 1.1 * length)));
    this._explain(view.text);
    this.look('arm');
  }

  _group(name) {
    if (!this.groups[name]) {
      this.groups[name] = new THREE.Group();
      this.world.add(this.groups[name]);
    }
    return this.groups[name];
  }

  // Rods between points: lines of a browser are one pixel wide.
  _addRods(group, starts, ends, radius) {
    const material = new THREE.MeshPhongMaterial();
    this._theme(material, `--${group}`);
    const rods = new THREE.InstancedMesh(new THREE.CylinderGeometry(1, 1, 1, 8), material, starts.length);
    const [up, turn, T] = [new THREE.Vector3(0, 1, 0), new THREE.Quaternion(), new THREE.Matrix4()];
    starts.forEach((start, i) => {
      const way = ends[i].clone().sub(start);
      const length = Math.max(way.length(), 1e-9);
      turn.setFromUnitVectors(up, way.divideScalar(length));
      const middle = start.clone().lerp(ends[i], 0.5);
      rods.setMatrixAt(i, T.compose(middle, turn, new THREE.Vector3(radius, length, radius)));
    });
    rods.frustumCulled = false;
    this._group(group).add(rods);
  }

  // The point under the pointer, in words.
  _explain(text) {
    const note = document.createElement('span');
    note.className = 'label note';
    note.hidden = true;
    this.place.append(note);
    const ray = new THREE.Raycaster();
    this.canvas.addEventListener('pointermove', (event) => {
      const [x, y] = [event.offsetX / this.place.clientWidth, event.offsetY / this.place.clientHeight];
      ray.params.Points.threshold = 0.006 * this.eye.distance;
      ray.setFromCamera(new THREE.Vector2(2 * x - 1, 1 - 2 * y), this.camera);
      const hits = this.dots.parent.visible && !event.buttons ? ray.intersectObject(this.dots) : [];
      hits.sort((a, b) => a.distanceToRay - b.distanceToRay);
      note.hidden = hits.length === 0;
      if (note.hidden) return;
      note.textContent = text[hits[0].index];
      note.style.left = `${100 * x}%`;
      note.style.top = `${100 * y}%`;
    });
  }
}
