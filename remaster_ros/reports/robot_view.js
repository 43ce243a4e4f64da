// Draws a scene (reports/scene_view.py) with three.js: the arm at any joint angles, lines of sight,
// a path with its configurations. Lengths in metres, angles in radians, z up. Colours are the
// page's: --ink, --line, --panel, --arm, --tool, --obstacle, --sight, --way.

class RobotView {
  static hasWebGL() {
    const canvas = document.createElement('canvas');
    try {
      return Boolean(canvas.getContext('webgl2') || canvas.getContext('webgl'));
    } catch {
      return false;
    }
  }

  constructor(place, scene) {
    this.place = place;
    this.scene = scene;
    this.fixed = scene.T_fixed.map((values) => new THREE.Matrix4().set(...values));
    this.axes = scene.axes.map((axis) => new THREE.Vector3(...axis));
    this.slides = scene.slides;
    this.markers = scene.sights.map((sight) => new THREE.Vector3(...sight.marker));
    this.sensors = scene.sights.map((sight) => new THREE.Vector3(...sight.place));
    this.themed = [];
    this.world = new THREE.Scene();
    this.links = Array.from({length: this.axes.length + 1}, () => new THREE.Group());
    for (const group of this.links) {
      group.matrixAutoUpdate = false;
      this.world.add(group);
    }
    scene.surfaces.forEach((surface) => this._addSurface(surface));
    this._addFloor();
    this._addSights();
    this.path = new THREE.Group();
    this.way = new THREE.Group();
    this.world.add(this.path, this.way);

    this.renderer = new THREE.WebGLRenderer({antialias: true, alpha: true});
    this.renderer.setPixelRatio(window.devicePixelRatio);
    this.canvas = this.renderer.domElement;
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute('aria-label', 'The arm in 3-D; drag to turn it');
    place.append(this.canvas);
    this.camera = new THREE.PerspectiveCamera(35, 1, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    const lamp = new THREE.DirectionalLight(0xffffff, 0.5);
    lamp.position.set(0.4, 0.6, 1);
    this.camera.add(lamp);
    this.world.add(this.camera, new THREE.HemisphereLight(0xffffff, 0x5c6672, 0.6));
    this.eye = {target: new THREE.Vector3(), distance: 3, turn: 0.9, tilt: 0.35};

    this._applyTheme();
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
      this._applyTheme();
      this.draw();
    });
    this._followPointers();
    new ResizeObserver(() => this._resize()).observe(place);
    this.pose(this.axes.map(() => 0));
    this.look('arm');
  }

  // Where the links are: the base, the frame after each joint, the tool.
  frames(q) {
    const frames = [new THREE.Matrix4()];
    const T = new THREE.Matrix4();
    const move = new THREE.Matrix4();
    this.axes.forEach((axis, i) => {
      if (this.slides[i]) move.makeTranslation(axis.x * q[i], axis.y * q[i], axis.z * q[i]);
      else move.makeRotationAxis(axis, q[i]);
      T.multiply(this.fixed[i]).multiply(move);
      frames.push(T.clone());
    });
    frames.push(T.multiply(this.fixed[this.axes.length]));
    return frames;
  }

  // Where the tool's origin is, or the marker of the first sensor.
  tip(q) {
    const T = this.frames(q).pop();
    return (this.markers[0] || new THREE.Vector3()).clone().applyMatrix4(T);
  }

  // Show the arm at joint angles; lines of sight are strong where it is measured.
  pose(q, measuring = true) {
    const frames = this.frames(q);
    this.links.forEach((group, i) => group.matrix.copy(frames[i]));
    const tool = frames[frames.length - 1];
    this.sights.forEach((line, i) => {
      const end = this.markers[i].clone().applyMatrix4(tool);
      const points = line.geometry.attributes.position;
      points.setXYZ(1, end.x, end.y, end.z);
      points.needsUpdate = true;
      line.material.opacity = measuring ? 0.95 : 0.22;
    });
    this.draw();
  }

  // Show a path (points along it) and the configurations on it, each with a colour variable.
  showPath(points, stops, colors) {
    this.path.clear();
    this.themed = this.themed.filter((entry) => entry.owner !== 'path');
    const line = new THREE.LineBasicMaterial({transparent: true, opacity: 0.16});
    this._theme(line, '--ink', 'path');
    this.path.add(new THREE.Line(new THREE.BufferGeometry().setFromPoints(points), line));
    for (const color of new Set(colors)) {
      const own = stops.filter((_, i) => colors[i] === color);
      const dots = new THREE.PointsMaterial({size: 6, sizeAttenuation: false});
      this._theme(dots, color, 'path');
      this.path.add(new THREE.Points(new THREE.BufferGeometry().setFromPoints(own), dots));
    }
    this.spread = new THREE.Box3().setFromPoints(points);
    this.look('arm');
  }

  // Show one way of the path as a tube.
  showWay(points) {
    this.way.clear();
    this.themed = this.themed.filter((entry) => entry.owner !== 'way');
    const length = points.slice(1).reduce((sum, p, i) => sum + p.distanceTo(points[i]), 0);
    if (length < 1e-4) return;
    const curve = new THREE.CatmullRomCurve3(points, false, 'centripetal');
    const tube = new THREE.TubeGeometry(curve, 6 * points.length, 0.004 * this.scene.reach, 8);
    const material = new THREE.MeshBasicMaterial();
    this._theme(material, '--way', 'way');
    this.way.add(new THREE.Mesh(tube, material));
  }

  // Look at the 'arm', at 'all' with the sensors, or from a sensor (its number).
  look(from) {
    const reach = this.scene.reach;
    const box = new THREE.Box3(
      new THREE.Vector3(-0.2 * reach, -0.2 * reach, 0),
      new THREE.Vector3(0.2 * reach, 0.2 * reach, 0.6 * reach)
    );
    if (this.spread && !this.spread.isEmpty()) box.union(this.spread);
    if (from === 'all') this.sensors.forEach((place) => box.expandByPoint(place));
    const eye = this.eye;
    box.getCenter(eye.target);
    if (typeof from === 'number') {
      const back = this.sensors[from].clone().sub(eye.target);
      eye.distance = back.length();
      eye.turn = Math.atan2(back.y, back.x);
      eye.tilt = Math.asin(back.z / eye.distance);
    } else {
      // From the side of the sensors, past them.
      const mean = this.sensors.reduce((sum, p) => sum.add(p), new THREE.Vector3());
      eye.turn = (this.sensors.length ? Math.atan2(mean.y, mean.x) : 0) + 0.9;
      eye.tilt = 0.35;
      eye.distance = this._distanceToSee(box);
    }
    this.draw();
  }

  // How far off the target the camera must be for all corners of a box to be in the picture.
  _distanceToSee(box) {
    const {target, turn, tilt} = this.eye;
    const right = new THREE.Vector3(-Math.sin(turn), Math.cos(turn), 0);
    const back = this._back(turn, tilt);
    const up = back.clone().cross(right);
    const high = Math.tan(THREE.MathUtils.degToRad(this.camera.fov) / 2);
    const wide = high * this._aspect();
    let distance = 0.1;
    for (let i = 0; i < 8; i += 1) {
      const corner = new THREE.Vector3(
        (i & 1 ? box.max : box.min).x, (i & 2 ? box.max : box.min).y, (i & 4 ? box.max : box.min).z
      ).sub(target);
      const across = Math.max(Math.abs(corner.dot(right)) / wide, Math.abs(corner.dot(up)) / high);
      distance = Math.max(distance, across + corner.dot(back));
    }
    return 1.03 * distance;
  }

  // From the target towards the camera.
  _back(turn, tilt) {
    return new THREE.Vector3(Math.cos(tilt) * Math.cos(turn), Math.cos(tilt) * Math.sin(turn), Math.sin(tilt));
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this._render();
      this._placeLabels();
    });
  }

  // What is seen now, for paper: a 3-D canvas is empty once its frame is over.
  copyTo(canvas) {
    this._render();
    [canvas.width, canvas.height] = [this.canvas.width, this.canvas.height];
    const flat = canvas.getContext('2d');
    flat.fillStyle = this.style.getPropertyValue('--paper').trim();
    flat.fillRect(0, 0, canvas.width, canvas.height);
    flat.drawImage(this.canvas, 0, 0);
  }

  _render() {
    const {target, distance, turn, tilt} = this.eye;
    this.camera.position.copy(this._back(turn, tilt)).multiplyScalar(distance).add(target);
    this.camera.near = distance / 100;
    this.camera.far = distance * 50;
    this.camera.updateProjectionMatrix();
    this.camera.lookAt(target);
    this.camera.updateMatrixWorld();
    this.renderer.render(this.world, this.camera);
  }

  _aspect() {
    return this.place.clientWidth / Math.max(this.place.clientHeight, 1);
  }

  _resize() {
    this.renderer.setSize(this.place.clientWidth, this.place.clientHeight);
    this.camera.aspect = this._aspect();
    this.draw();
  }

  _theme(material, variable, owner = 'scene') {
    this.themed.push({material, variable, owner});
    if (this.style) material.color.set(this.style.getPropertyValue(variable).trim());
  }

  _applyTheme() {
    this.style = getComputedStyle(document.documentElement);
    for (const {material, variable} of this.themed) {
      material.color.set(this.style.getPropertyValue(variable).trim());
    }
  }

  _addSurface(surface) {
    const positions = this._decoded(surface.vertices, Uint16Array);
    const faces = this._decoded(surface.faces, surface.wide ? Uint32Array : Uint16Array);
    const points = new Float32Array(positions.length);
    positions.forEach((value, i) => {
      points[i] = surface.low[i % 3] + surface.step[i % 3] * value;
    });
    const material = new THREE.MeshPhongMaterial({shininess: 25, specular: 0x222222});
    if (surface.color) {
      // Black parts stay visible on a dark page.
      material.color.setRGB(...surface.color).lerp(new THREE.Color(0xffffff), 0.1);
    } else {
      const roles = {link: '--arm', tool: '--tool', marker: '--sight', obstacle: '--obstacle'};
      this._theme(material, roles[surface.role]);
    }
    if (surface.role === 'obstacle') Object.assign(material, {transparent: true, opacity: 0.45});
    const mesh = new THREE.Mesh(RobotView._shaded(points, faces), material);
    mesh.name = surface.name;
    this.links[surface.link].add(mesh);
  }

  _decoded(text, Kind) {
    return new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  }

  // Triangles with normals that are smooth but across edges of more than 40 degrees.
  static _shaded(points, faces) {
    const corners = new Float32Array(3 * faces.length);
    const normals = new Float32Array(3 * faces.length);
    const own = new Float32Array(faces.length);
    const around = new Map();
    const [a, b, c] = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
    for (let i = 0; i < faces.length; i += 3) {
      [a, b, c].forEach((v, k) => v.fromArray(points, 3 * faces[i + k]).toArray(corners, 3 * (i + k)));
      b.sub(a).cross(c.sub(a)).normalize().toArray(own, i);
      for (let k = 0; k < 3; k += 1) {
        const vertex = faces[i + k];
        if (!around.has(vertex)) around.set(vertex, []);
        around.get(vertex).push(i);
      }
    }
    for (let i = 0; i < faces.length; i += 1) {
      a.fromArray(own, i - (i % 3));
      c.set(0, 0, 0);
      for (const face of around.get(faces[i])) {
        if (b.fromArray(own, face).dot(a) > 0.766) c.add(b);
      }
      c.normalize().toArray(normals, 3 * i);
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.BufferAttribute(corners, 3));
    geometry.setAttribute('normal', new THREE.BufferAttribute(normals, 3));
    return geometry;
  }

  _addFloor() {
    if (this.scene.floor_z === null) return;
    const size = 2 * Math.ceil(this.scene.reach + 0.5);
    // A line every half metre.
    const grid = new THREE.GridHelper(size, 2 * size, 0xffffff, 0xffffff);
    grid.geometry.deleteAttribute('color');
    const material = new THREE.LineBasicMaterial({transparent: true, opacity: 0.75});
    grid.material = material;
    this._theme(material, '--line');
    grid.rotation.x = Math.PI / 2;
    grid.position.z = this.scene.floor_z;
    this.world.add(grid);
  }

  _addSights() {
    this.sights = [];
    this.labels = [];
    this.sensors.forEach((place, i) => {
      const line = new THREE.LineBasicMaterial({transparent: true});
      this._theme(line, '--sight');
      const geometry = new THREE.BufferGeometry().setFromPoints([place, place.clone()]);
      const sight = new THREE.Line(geometry, line);
      sight.frustumCulled = false;
      this.sights.push(sight);
      this.world.add(sight);
      if (this.scene.sights.slice(0, i).some((other) => other.sensor === this.scene.sights[i].sensor)) return;
      const solid = new THREE.MeshPhongMaterial();
      this._theme(solid, '--sight');
      const body = new THREE.Mesh(new THREE.ConeGeometry(0.055, 0.14, 24), solid);
      body.position.copy(place);
      // Its base, through which it looks, towards the arm.
      body.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), place.clone().normalize());
      this.world.add(body);
      this._addLabel(this.scene.sights[i].sensor, place);
    });
  }

  _addLabel(text, place) {
    const label = document.createElement('span');
    label.textContent = text;
    label.className = 'label';
    this.place.append(label);
    this.labels.push({label, place});
  }

  _placeLabels() {
    for (const {label, place} of this.labels) {
      const at = place.clone().project(this.camera);
      const visible = Math.abs(at.x) < 1 && Math.abs(at.y) < 1 && at.z < 1;
      label.hidden = !visible;
      label.style.left = `${50 + 50 * at.x}%`;
      label.style.top = `${50 - 50 * at.y}%`;
    }
  }

  _move(dx, dy) {
    // A hand's breadth of the picture moves the target by as much.
    const {target, distance} = this.eye;
    const scale = (distance * Math.tan(THREE.MathUtils.degToRad(this.camera.fov) / 2) * 2) / this.place.clientHeight;
    const right = new THREE.Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0);
    const up = new THREE.Vector3().setFromMatrixColumn(this.camera.matrixWorld, 1);
    target.addScaledVector(right, -dx * scale).addScaledVector(up, dy * scale);
  }

  _turn(dx, dy) {
    this.eye.turn -= 0.008 * dx;
    this.eye.tilt = Math.min(1.55, Math.max(-1.55, this.eye.tilt + 0.008 * dy));
  }

  _zoom(factor) {
    this.eye.distance = Math.min(200, Math.max(0.05, this.eye.distance * factor));
  }

  _followPointers() {
    const held = new Map();
    const apart = () => {
      const [a, b] = [...held.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    this.canvas.addEventListener('pointerdown', (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, {x: event.clientX, y: event.clientY});
    });
    for (const name of ['pointerup', 'pointercancel']) {
      this.canvas.addEventListener(name, (event) => held.delete(event.pointerId));
    }
    this.canvas.addEventListener('pointermove', (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
      if (held.size === 2) {
        const was = apart();
        held.set(event.pointerId, {x: event.clientX, y: event.clientY});
        this._zoom(was / Math.max(apart(), 1));
        this._move(dx / 2, dy / 2);
      } else {
        held.set(event.pointerId, {x: event.clientX, y: event.clientY});
        if (event.buttons > 1 || event.shiftKey) this._move(dx, dy);
        else this._turn(dx, dy);
      }
      this.draw();
    });
    this.canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    // The wheel scrolls the page until the picture was clicked.
    const wheel = (event) => {
      if (document.activeElement !== this.canvas) return;
      event.preventDefault();
      this._zoom(Math.exp(0.001 * event.deltaY));
      this.draw();
    };
    this.canvas.addEventListener('wheel', wheel, {passive: false});
    const keys = {
      ArrowLeft: () => this._turn(-12, 0), ArrowRight: () => this._turn(12, 0),
      ArrowUp: () => this._turn(0, 12), ArrowDown: () => this._turn(0, -12),
      '+': () => this._zoom(0.9), '-': () => this._zoom(1.1),
    };
    this.canvas.addEventListener('keydown', (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
      this.draw();
    });
  }
}
