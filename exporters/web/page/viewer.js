// Draws a shot: decodes the block of scene.py, builds it with three.js, and moves it frame by frame.
// Lengths are metres, Z is up, times are frames; quaternions are x, y, z, w.
"use strict";

const vehsim = { keys: [] }; // keys and what they do, beside those of the viewer

(() => {
  const KINDS = { f4: Float32Array, i1: Int8Array, u1: Uint8Array, i2: Int16Array, u4: Uint32Array };
  const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
  const ACCENT = 0xff8a3d, PATH = 0x2fb4ff, FRUSTUM = 0xe8e8e8;
  const COMPARED = [0xf2d13c, 0x6fd66f, 0xd58cff, 0xff6f91, 0x4fd6c8, 0xc0a080, 0x9fb4ff, 0xe0e0e0];
  const FAR = 20000;
  const CLEAR = 4; // haze hides everything no nearer than this many times the orbit's distance, as in pictures
  const NOTE_SECONDS = 3; // a note is shown so long, or until the next one
  const SHADOW_MAP = 4096;
  const KEYS = [
    ["Space", "play, pause"], ["\u2190 \u2192", "one frame; with Shift ten"], [", .", "previous, next mark or note"],
    ["Home End", "first, last frame"], ["L", "loop"], ["0", "orbit"], ["1 to 9", "look through a camera"],
    ["F", "frame the vehicle"], ["P G C", "paths, ghosts at marks, cameras"], ["?", "this help"],
  ];
  const ICONS = { // of buttons, by id: not every system has a font with these signs
    start: "M1 1h2v10H1zM11 1v10L4 6z", back: "M8 1 9 2 5 6l4 4-1 1-5-5z", play: "M2 1l9 5-9 5z",
    pause: "M2 1h3v10H2zM7 1h3v10H7z", forward: "M4 1 3 2l4 4-4 4 1 1 5-5z", end: "M11 1H9v10h2zM1 1v10l7-5z",
    loop: "M6 1.5A4.5 4.5 0 1 0 10.5 6H9A3 3 0 1 1 6 3v2l3.5-2.75L6-.5z",
  };
  const element = (id) => document.getElementById(id);

  /** Show an icon in a button. */
  const draw = (button, icon) => (button.innerHTML = `<svg viewBox="-1 -1 14 14" aria-hidden="true"><path d="${ICONS[icon]}"/></svg>`);

  // ---------------------------------------------------------------- the block of bytes

  /** The header of a block, and a function from a reference in it to its array. */
  vehsim.decode = (buffer) => {
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const start = 4 + length;
    const array = (ref) => {
      const kind = KINDS[ref.kind] || Uint8Array;
      return new kind(buffer, start + ref.at, ref.size / kind.BYTES_PER_ELEMENT);
    };
    return { header, array };
  };

  /** The block inside the page: base64 of zlib. */
  async function embedded() {
    const text = atob(element("scene").textContent.trim());
    const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  }

  vehsim.say = (text) => {
    element("message").textContent = text;
    element("message").hidden = !text;
  };

  vehsim.open = async () => {
    window.addEventListener("error", (event) => vehsim.say(`This page failed:\n${event.message}`));
    if (!window.DecompressionStream) {
      vehsim.say("This browser cannot decompress the shot.\nUse Chrome 80, Firefox 113, Safari 16.4 or later.");
      return;
    }
    try {
      const { header, array } = vehsim.decode(await embedded());
      vehsim.viewer = new Viewer(header, array);
      await vehsim.viewer.ready;
      vehsim.say("");
    } catch (error) {
      vehsim.say(`This shot cannot be shown:\n${error.message}`);
      throw error;
    }
  };

  // ---------------------------------------------------------------- the viewer

  class Viewer {
    constructor(header, array) {
      this.header = header;
      this.array = array;
      this.origin = new THREE.Vector3(...header.origin);
      [this.first, this.last] = header.frames;
      this.frame = this.first;
      this.playing = false;
      this.loop = true;
      this.speed = 1;
      this.through = header.cameras.length ? header.cameras.length - 1 : -1; // a cut comes last
      this.shown = { paths: true, ghosts: false, cameras: false };
      this.stale = true;
      this.live = null; // the frame of a drive
      this.over = new AbortController();
      this._makeRenderer();
      this._makeLight();
      this._makeShapes();
      this._makeCameras();
      this.water = header.water && new Water(header.water, array, this._waterMaterial(header.water), this.scene);
      this.tyreMarks = (header.tyreMarks || []).map((given) => new TyreMark(given, array, this));
      this._makeOverlays();
      this.setMotion(header, array);
      this._makeControls();
      this.timeline = new Timeline(this);
      this._listen();
      this.frameVehicle();
      this.show(this.frame);
      this.ready = Promise.all(this.loading);
      this.ready.then(() => requestAnimationFrame((now) => this._tick(now)));
    }

    // ---- made once

    _makeRenderer() {
      const before = element("view"), canvas = before.cloneNode(); // a canvas keeps its context
      before.replaceWith(canvas);
      this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
      this.renderer.toneMapping = THREE.NeutralToneMapping;
      this.renderer.shadowMap.enabled = true;
      this.renderer.shadowMap.type = THREE.PCFShadowMap;
      this.scene = new THREE.Scene();
      this.camera = new THREE.PerspectiveCamera(40, 1, 0.1, FAR);
      this.camera.up.set(0, 0, 1);
      this.orbit = new THREE.OrbitControls(this.camera, canvas);
      this.orbit.addEventListener("change", () => (this.stale = true));
      this.loading = [];
    }

    /** A texture from bytes in the block. */
    texture(ref, changes = {}) {
      const texture = new THREE.Texture();
      const url = URL.createObjectURL(new Blob([this.array(ref)], { type: ref.type }));
      const image = new Image();
      this.loading.push(new Promise((done, fail) => {
        image.onload = () => { URL.revokeObjectURL(url); texture.needsUpdate = true; done(); };
        image.onerror = () => fail(new Error("a picture in this file cannot be decoded"));
      }));
      image.src = url;
      texture.image = image;
      texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
      texture.anisotropy = this.renderer.capabilities.getMaxAnisotropy();
      return Object.assign(texture, changes);
    }

    _makeLight() {
      const light = this.header.light;
      this.sun = new THREE.DirectionalLight(new THREE.Color(...light.sun), 1);
      this.sun.castShadow = true;
      const side = Math.min(SHADOW_MAP, this.renderer.capabilities.maxTextureSize);
      this.sun.shadow.mapSize.set(side, side);
      this.sun.shadow.bias = -0.0005;
      this.sun.shadow.normalBias = 0.03;
      this.sunward = new THREE.Vector3(...light.direction).negate();
      this.scene.add(this.sun, this.sun.target);
      const texture = this.texture(light.sky, { colorSpace: THREE.SRGBColorSpace });
      this.sky = new THREE.Mesh(
        skyDome(light.R_wd),
        new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide, depthWrite: false, depthTest: false, fog: false, toneMapped: false }),
      );
      this.sky.renderOrder = -1;
      this.sky.frustumCulled = false;
      this.scene.add(this.sky);
      const haze = new THREE.Color().setRGB(...light.haze.colour, THREE.SRGBColorSpace);
      this.scene.fog = new THREE.Fog(haze, light.haze.start, light.haze.end);
      this.scene.background = haze;
      this.loading[this.loading.length - 1] = this.loading[this.loading.length - 1].then(() => {
        const around = new THREE.Scene(), dome = this.sky.clone();
        dome.position.set(0, 0, 0); // the sky follows the camera
        around.add(dome);
        const generator = new THREE.PMREMGenerator(this.renderer);
        this.scene.environment = generator.fromScene(around, 0, 0.1, 100).texture;
        generator.dispose();
        this.stale = true;
      });
      if (!light.grounded && !this.header.water) {
        const grid = new THREE.GridHelper(400, 80, 0x8a9299, 0x60686f);
        grid.rotation.x = Math.PI / 2;
        grid.material.transparent = true;
        grid.material.opacity = 0.5;
        this.scene.add(grid);
      }
    }

    _makeShapes() {
      const { header, array } = this;
      const textures = header.textures.map((ref) => this.texture(ref, { colorSpace: THREE.SRGBColorSpace }));
      const made = new Map();
      const material = (k, double) => {
        const key = `${k} ${double}`;
        if (!made.has(key)) {
          const given = header.materials[k];
          const colour = given.texture === null ? new THREE.Color().setRGB(...given.colour) : new THREE.Color(1, 1, 1);
          made.set(key, new THREE.MeshStandardMaterial({
            color: colour,
            map: given.texture === null ? null : textures[given.texture],
            roughness: given.roughness,
            metalness: given.metallic,
            emissive: given.emission ? colour : 0,
            emissiveIntensity: given.emission,
            opacity: given.opacity,
            transparent: given.opacity < 1,
            depthWrite: given.opacity === 1,
            side: double || given.opacity < 1 ? THREE.DoubleSide : THREE.FrontSide,
          }));
        }
        return made.get(key);
      };
      this.groups = header.groups.map(() => {
        const group = new THREE.Group();
        group.matrixAutoUpdate = false;
        this.scene.add(group);
        return group;
      });
      for (const shape of header.shapes) {
        const geometry = new THREE.BufferGeometry();
        geometry.setAttribute("position", new THREE.BufferAttribute(array(shape.points), 3));
        geometry.setAttribute("normal", new THREE.BufferAttribute(array(shape.normals), 4, true));
        if (shape.uvs) geometry.setAttribute("uv", new THREE.BufferAttribute(array(shape.uvs), 2));
        geometry.setIndex(new THREE.BufferAttribute(array(shape.faces), 1));
        const mesh = new THREE.Mesh(geometry, material(shape.material, shape.double));
        mesh.castShadow = header.materials[shape.material].opacity > 0.5;
        mesh.receiveShadow = true;
        mesh.name = shape.name;
        (shape.group < 0 ? this.scene : this.groups[shape.group]).add(mesh);
      }
    }

    _makeCameras() {
      const aspect = this.header.picture[0] / this.header.picture[1];
      this.cameras = this.header.cameras.map((given) => {
        const [half] = this.array(given.lens);
        const [x, y, z] = [1.5 * half, (1.5 * half) / aspect, -1.5];
        const corners = [[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]];
        const points = [];
        corners.forEach((corner, k) => points.push([0, 0, 0], corner, corner, corners[(k + 1) % 4]));
        points.push([-0.4 * x, 1.1 * y, z], [0, 1.5 * y, z], [0, 1.5 * y, z], [0.4 * x, 1.1 * y, z]); // up
        const frustum = new THREE.LineSegments(lines(points), new THREE.LineBasicMaterial({ color: FRUSTUM, fog: false }));
        frustum.matrixAutoUpdate = false;
        this.scene.add(frustum);
        return { ...given, frustum, poses: this.array(given.poses), lens: this.array(given.lens), aspect };
      });
    }

    _makeOverlays() {
      this.overlays = { paths: new THREE.Group(), ghosts: new THREE.Group(), handles: new THREE.Group(), compared: new THREE.Group(), iterates: new THREE.Group() };
      this.compared = [];
      this.scene.add(...Object.values(this.overlays));
    }

    // ---- what a new solution replaces

    /** The motion, from a header with groups, paths, marks and curves. */
    setMotion(header, array) {
      this.motion = header;
      this.poses = header.groups.map((group) => array(group.poses));
      this.curves = header.curves.map((curve) => ({ ...curve, values: array(curve.values) }));
      this.drafted = "";
      this.marks = header.marks;
      this.ticks = [...header.marks, ...header.unplaced];
      this.notes = header.notes;
      for (const overlay of [this.overlays.paths, this.overlays.ghosts]) dispose(overlay);
      this.lines = new Map(header.paths.map((path) => [path.name, this._addPath(array(path.points))]));
      this.rings = header.marks.map((mark) => this._addMark(mark));
      for (const given of header.cameras || []) {
        const camera = this.cameras.find((each) => each.name === given.name);
        if (camera) Object.assign(camera, { poses: array(given.poses), lens: array(given.lens) });
      }
      this.vehicles = header.paths.map((path) => path.name);
      this.stale = true;
      if (this.timeline) { this.timeline.build(); this.show(this.frame); }
    }

    /** The poses and the paths of some vehicles, while a handle is dragged. */
    setDraft(header, array) {
      this.drafted = header.kind === "preview" ? "of the straight guess" : "before the drag"; // what the curves still are
      for (const group of header.groups) this.poses[group.index] = array(group.poses);
      for (const path of header.paths)
        this.lines.get(path.name).geometry.setAttribute("position", new THREE.BufferAttribute(array(path.points), 3));
      this.show(this.frame);
    }

    /** The path of a vehicle at an iteration of a solve, beside the present motion. */
    setIterate(header, array) {
      this.clearIterates();
      for (const path of header.paths) {
        const geometry = new THREE.BufferGeometry();
        geometry.setAttribute("position", new THREE.BufferAttribute(array(path.points), 3));
        const line = new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: ACCENT, transparent: true, opacity: 0.6, fog: false }));
        line.frustumCulled = false;
        this.overlays.iterates.add(line);
      }
      this.stale = true;
    }

    clearIterates() {
      dispose(this.overlays.iterates);
      this.stale = true;
    }

    /** Other motions of the vehicles, each in a colour of its own, beside the present one. */
    setCompared(header, array) {
      dispose(this.overlays.compared);
      this.compared = header.motions.map((given, at) => {
        const color = COMPARED[at % COMPARED.length], parts = [];
        const glass = new THREE.MeshStandardMaterial({ color, transparent: true, opacity: 0.55, depthWrite: false });
        for (const { index, poses } of given.groups) {
          const copy = new THREE.Group();
          copy.matrixAutoUpdate = false;
          copy.userData.shared = true;
          for (const mesh of this.groups[index].children) copy.add(new THREE.Mesh(mesh.geometry, glass));
          this.overlays.compared.add(copy);
          parts.push({ copy, poses: array(poses) });
        }
        const geometry = new THREE.BufferGeometry();
        geometry.setAttribute("position", new THREE.BufferAttribute(array(given.points), 3));
        const line = new THREE.Line(geometry, new THREE.LineBasicMaterial({ color, fog: false }));
        line.frustumCulled = false;
        this.overlays.compared.add(line);
        const curves = given.curves.map((curve) => ({ ...curve, values: array(curve.values) }));
        return { ...given, color: `#${color.toString(16).padStart(6, "0")}`, parts, curves };
      });
      this.show(this.frame);
    }

    _showCompared(k) {
      for (const { copy, poses } of this.compared.flatMap((one) => one.parts)) {
        setPose(copy.matrix, poses, k);
        copy.matrixWorldNeedsUpdate = true;
      }
    }

    _waterMaterial(given) {
      const material = new THREE.MeshStandardMaterial({
        vertexColors: true, roughness: given.rough, metalness: 0, side: THREE.DoubleSide,
        normalMap: this.texture(given.ripples), normalScale: new THREE.Vector2(1.6, 1.6),
      });
      material.userData = { tile: given.tile, clear: given.clear, white: given.white };
      if (given.waves) addDistantWaves(material, given.waves.length);
      return material;
    }

    /** Another motion of the water. */
    setWater(header, array) {
      const { mesh } = this.water;
      this.scene.remove(mesh);
      mesh.geometry.dispose();
      this.water = new Water(header, array, mesh.material, this.scene);
      this.show(this.frame);
    }

    /** A driven vehicle as it is now, among the others in that frame, with the orbit's camera on a rope behind it. */
    setLive(header, array) {
      const k = this._index(Math.round(header.frame));
      this.groups.forEach((group, g) => {
        setPose(group.matrix, this.poses[g], k);
        group.matrixWorldNeedsUpdate = true;
      });
      for (const group of header.groups) {
        setPose(this.groups[group.index].matrix, array(group.poses), 0);
        this.groups[group.index].matrixWorldNeedsUpdate = true;
      }
      if (this.water) this.water.show(k);
      this._showCompared(k);
      this.live = Math.floor(header.frame);
      if (performance.now() > (this.told || 0) + 200) { // seldom: it costs the picture time
        this.told = performance.now();
        this.timeline.draw();
      }
      const place = new THREE.Vector3(...header.place);
      if (!this.trail) {
        this.trail = { points: [], line: new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: ACCENT, fog: false })) };
        this.trail.line.frustumCulled = false;
        this.scene.add(this.trail.line);
        this.lookThrough(-1);
        this.orbit.target.copy(place);
        const turn = new THREE.Vector3(-1, 0, 0.35).applyAxisAngle(this.camera.up, (header.heading * Math.PI) / 180);
        this.camera.position.copy(place).addScaledVector(turn, 3.5 * this._size(header.vehicle));
      }
      const { points, line } = this.trail;
      if (!points.length || points[points.length - 1].distanceTo(place) > 0.2) {
        points.push(place);
        line.geometry.dispose();
        line.geometry = new THREE.BufferGeometry().setFromPoints(points);
      }
      this._tow(place);
    }

    /** Move the orbit's target to a place; the camera follows as on a rope of constant length. */
    _tow(place) {
      const rope = this.camera.position.clone().sub(this.orbit.target), reach = Math.hypot(rope.x, rope.y), height = rope.z;
      const pulled = this.camera.position.clone().sub(place).setZ(0).setLength(reach);
      this.orbit.target.copy(place);
      this.camera.position.copy(place).add(pulled.setZ(height));
      this.orbit.update();
      this.stale = true;
    }

    /** Show the solved motion again after a drive, and the vehicle where it is in the present frame. */
    endLive() {
      if (this.trail) this.scene.remove(this.trail.line);
      this.trail = this.live = null;
      const moved = (this.subject() || this.orbit.target.clone()).sub(this.orbit.target);
      this.camera.position.add(moved);
      this.orbit.target.add(moved);
      this.orbit.update();
      this.show(this.frame);
    }

    _addPath(points) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
      const line = new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: PATH, fog: false }));
      const ticks = new THREE.Points(geometry, new THREE.PointsMaterial({ color: PATH, size: 3, sizeAttenuation: false, fog: false }));
      line.frustumCulled = ticks.frustumCulled = false;
      this.overlays.paths.add(line, ticks);
      return line;
    }

    /** A ring in the plane that keeps its size in the picture, with an arrow along a heading in degrees or null. */
    addRing(overlay, position, heading, color) {
      const circle = Array.from({ length: 33 }, (_, k) => [Math.cos(k * Math.PI / 16), Math.sin(k * Math.PI / 16), 0]);
      const points = [];
      for (let k = 0; k < 32; k++) points.push(circle[k], circle[k + 1]);
      if (heading === null) points.push([-0.3, 0, 0], [0.3, 0, 0], [0, -0.3, 0], [0, 0.3, 0]);
      else points.push([0, 0, 0], [2, 0, 0], ...head(2));
      return this._addHandle(overlay, position, points, color, heading || 0, 0);
    }

    /** An arrow along a direction, with two heads, longer than that of a ring in the same place. */
    addArrow(overlay, position, heading, tilt, color) {
      const arrow = this._addHandle(overlay, position, [[0, 0, 0], [3.4, 0, 0], ...head(3.4), ...head(3.1)], color, heading, tilt);
      arrow.userData.tip = 3.4;
      return arrow;
    }

    _addHandle(overlay, position, points, color, heading, tilt) {
      const made = new THREE.LineSegments(lines(points), new THREE.LineBasicMaterial({ color, fog: false, depthTest: false }));
      made.position.set(...position);
      turn(made, heading, tilt);
      made.renderOrder = 2;
      made.userData.tip = 2;
      overlay.add(made);
      return made;
    }

    /** A mark's ring, its gate, and the vehicle's ghost. */
    _addMark(mark) {
      const ring = this.addRing(this.overlays.paths, mark.position, mark.heading, ACCENT);
      if (mark.gate) {
        const { points, heading, tilt } = mark.gate, border = points.flatMap((point, k) => (k ? [points[k - 1], point] : []));
        const gate = new THREE.LineSegments(lines(border), new THREE.LineBasicMaterial({ color: ACCENT, fog: false }));
        turn(gate, heading, tilt);
        ring.userData.carries = gate;
        this.overlays.paths.add(gate);
      }
      const ghost = new THREE.Group();
      const glass = new THREE.MeshStandardMaterial({ color: ACCENT, transparent: true, opacity: 0.25, depthWrite: false });
      this.groups.forEach((group, k) => {
        if (this.motion.groups[k].vehicle !== mark.vehicle) return;
        const copy = new THREE.Group();
        copy.matrixAutoUpdate = false;
        setPose(copy.matrix, this.poses[k], this._index(Math.round(mark.frame)));
        for (const mesh of group.children) copy.add(new THREE.Mesh(mesh.geometry, glass));
        ghost.add(copy);
      });
      ghost.userData.shared = true;
      this.overlays.ghosts.add(ghost);
      return ring;
    }

    /** The marks on the timeline, where the file has others than the motion; those with frame null are left out. */
    setTicks(given) {
      if (JSON.stringify(given) === JSON.stringify(this.ticks)) return;
      this.ticks = given;
      this.timeline.build();
    }

    /** Other notes, at places of the world. */
    setNotes(given) {
      const notes = given.map((one) => ({ ...one, position: one.position && this.local(one.position).toArray() }));
      if (JSON.stringify(notes) === JSON.stringify(this.notes)) return;
      this.notes = notes;
      this.timeline.build();
      this.stale = true;
    }

    /** The note of this frame, at the place that it points at or above the picture. */
    _showNote(view) {
      const box = element("note"), last = NOTE_SECONDS * this.header.fps;
      const past = this.notes.filter((one) => one.frame <= this.frame), frame = Math.max(...past.map((one) => one.frame));
      const now = this.frame < frame + last ? past.filter((one) => one.frame === frame) : [];
      box.hidden = !now.length;
      if (!now.length) return;
      box.textContent = now.map((one) => one.text).join("\n");
      const { position } = now.find((one) => one.position) || {};
      const at = position && new THREE.Vector3(...position).project(view), seen = at && at.z < 1 && Math.abs(at.x) < 1 && Math.abs(at.y) < 1;
      box.className = seen ? "at" : "";
      box.style.left = seen ? `${50 * (at.x + 1)}%` : "";
      box.style.top = seen ? `${50 * (1 - at.y)}%` : "";
    }

    /** Rings that are no marks, and arrows of directions, in place of those before. */
    setHandles(given) {
      const { handles } = this.overlays;
      dispose(handles);
      this.stale = true;
      return given.map(({ place, heading, turns, tilt }) =>
        tilt === null ? this.addRing(handles, this.local(place), turns ? heading : null, FRUSTUM) : this.addArrow(handles, this.local(place), heading, tilt, ACCENT));
    }

    /** A place of the world in the scene, whose positions are relative to its origin so that single precision suffices. */
    local(place) {
      return new THREE.Vector3(...place).sub(this.origin);
    }

    /** A point of the scene as a place of the world. */
    world(point) {
      return point.clone().add(this.origin).toArray();
    }

    /** The camera of the picture: the shot's, or that of the orbit. */
    get view() {
      return this.through >= 0 ? this.shotCamera : this.camera;
    }

    /** Take over frame, view and choices of another viewer, and end that one. */
    replace(other) {
      const { vehicle, name } = other.curves[other.curve] || {};
      this._choose("speed", other.speed);
      if (!other.follow || this.vehicles.includes(other.follow)) this._choose("follow", other.follow);
      this._choose("curve", this.curves.findIndex((curve) => curve.vehicle === vehicle && curve.name === name));
      if (!other.loop) element("loop").click();
      this.show(other.frame); // first: it moves the camera with the vehicle
      this.camera.position.copy(this.local(other.world(other.camera.position)));
      this.orbit.target.copy(this.local(other.world(other.orbit.target)));
      this.orbit.update();
      if (other.through < this.cameras.length) this.lookThrough(other.through);
      for (const key of Object.keys(this.shown)) if (this.shown[key] !== other.shown[key]) element(`show-${key}`).click();
      if (other.playing) this.play();
      other.close();
    }

    /** The orbit follows another vehicle; its curve takes the place of that before. */
    _follow(vehicle) {
      this.follow = vehicle;
      const { name } = this.curves[this.curve] || {}, own = this.curves.filter((curve) => curve.vehicle === vehicle);
      this._choose("curve", this.curves.indexOf(own.find((curve) => curve.name === name) || own[0]));
      this.timeline.build();
    }

    /** Choose an entry of a list below the timeline; -1: none. */
    _choose(id, value) {
      const list = element(id);
      if (!list || value === -1) return;
      list.value = String(value);
      list.dispatchEvent(new Event("change"));
    }

    close() {
      this.over.abort();
      this.closed = true;
      this.renderer.dispose();
      this.renderer.forceContextLoss();
    }

    // ---- every frame

    _index(frame) {
      return Math.min(Math.max(frame, this.first), this.last) - this.first;
    }

    /** Show a whole frame. */
    show(frame) {
      const before = this.subject();
      this.frame = Math.min(Math.max(Math.round(frame), this.first), this.last);
      const k = this._index(this.frame);
      this.groups.forEach((group, g) => {
        setPose(group.matrix, this.poses[g], k);
        group.matrixWorldNeedsUpdate = true;
      });
      if (this.water) this.water.show(k);
      for (const mark of this.tyreMarks) mark.show(this.frame);
      this._showCompared(k);
      for (const camera of this.cameras) setPose(camera.frustum.matrix, camera.poses, k);
      const after = this.subject();
      if (before && after && this.follow) {
        const moved = after.clone().sub(before);
        this.camera.position.add(moved);
        this.orbit.target.add(moved);
      }
      if (this.timeline) this.timeline.draw();
      this.stale = true;
    }

    /** Where the vehicle is that the orbit follows. */
    subject() {
      const k = this.motion.groups.findIndex((group) => group.vehicle === (this.follow || this.vehicles[0]));
      if (k < 0) return null;
      const poses = this.poses[k], at = 7 * this._index(this.frame);
      return new THREE.Vector3(poses[at], poses[at + 1], poses[at + 2]);
    }

    /** Place the orbit around the vehicle, seen from behind and from the side. */
    frameVehicle() {
      const subject = this.subject() || new THREE.Vector3();
      this.orbit.target.copy(subject);
      const away = new THREE.Vector3(-2.2, -2.2, 1.1).multiplyScalar(this._size(this.follow || this.vehicles[0]));
      this.camera.position.copy(subject).add(away);
      this.orbit.update();
      this.stale = true;
    }

    /** The largest coordinate of a vehicle's parts, m. */
    _size(name) {
      let size = 1;
      this.header.shapes.forEach((shape) => {
        if (shape.group < 0 || this.motion.groups[shape.group].vehicle !== name) return;
        const points = this.array(shape.points);
        for (let i = 0; i < points.length; i++) size = Math.max(size, Math.abs(points[i]));
      });
      return size;
    }

    lookThrough(k) {
      this.through = k;
      this.orbit.enabled = k < 0;
      element("cameras").value = String(k);
      this.stale = true;
    }

    play(on = !this.playing) {
      this.playing = on;
      if (on && this.frame === this.last) this.show(this.first);
      this.started = { at: performance.now(), frame: this.frame };
      draw(element("play"), on ? "pause" : "play");
      element("play").setAttribute("aria-pressed", on);
    }

    seek(frame) {
      this.show(frame);
      if (this.playing) this.started = { at: performance.now(), frame: this.frame };
    }

    _tick(now) {
      if (this.closed) return;
      requestAnimationFrame((next) => this._tick(next));
      if (this.playing) {
        const passed = Math.floor(((now - this.started.at) / 1000) * this.header.fps * this.speed);
        let frame = this.started.frame + Math.max(passed, 0);
        if (frame > this.last) {
          if (this.loop) {
            frame = this.first;
            this.started = { at: now, frame };
          } else {
            frame = this.last;
            this.play(false);
          }
        }
        if (frame !== this.frame) this.show(frame);
      }
      if (this.stale || this._resized()) this.draw();
    }

    _resized() {
      const canvas = this.renderer.domElement, ratio = this.renderer.getPixelRatio();
      return canvas.width !== Math.floor(canvas.clientWidth * ratio) || canvas.height !== Math.floor(canvas.clientHeight * ratio);
    }

    draw() {
      this.stale = false;
      const main = element("stage"), width = main.clientWidth, height = main.clientHeight;
      this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
      this.renderer.setSize(width, height, false);
      const gate = element("gate");
      if (this.through >= 0) this._lookAsShot(width, height, gate.style);
      else {
        gate.style.display = "none";
        const away = this.camera.position.distanceTo(this.orbit.target);
        this.camera.aspect = width / height;
        this.camera.near = Math.min(Math.max(away / 200, 0.02), 5);
        this.camera.updateProjectionMatrix();
        this.scene.fog.far = Math.max(this.header.light.haze.end, CLEAR * away);
      }
      const view = this.view;
      this.cameras.forEach((camera, k) => (camera.frustum.visible = this.shown.cameras && k !== this.through));
      this.overlays.paths.visible = this.shown.paths;
      this.overlays.ghosts.visible = this.shown.ghosts;
      this.overlays.handles.visible = this.overlays.iterates.visible = this.shown.paths;
      for (const ring of [...this.rings, ...this.overlays.handles.children]) {
        ring.scale.setScalar(Math.max(0.03 * view.position.distanceTo(ring.position), 0.3));
        if (ring.userData.carries) ring.userData.carries.position.copy(ring.position);
      }
      this.sky.position.copy(view.position);
      this._placeShadow(view);
      this.renderer.render(this.scene, view);
      this._showNote(view);
    }

    /** The view of a shot's camera: its picture as large as fits, and what surrounds it darkened. */
    _lookAsShot(width, height, gate) {
      const camera = this.cameras[this.through], k = this._index(this.frame);
      this.scene.fog.far = this.header.light.haze.end;
      const view = (this.shotCamera ||= new THREE.PerspectiveCamera());
      view.matrixAutoUpdate = false;
      setPose(view.matrix, camera.poses, k);
      view.matrix.decompose(view.position, view.quaternion, view.scale);
      view.matrixWorldNeedsUpdate = true;
      const [half, right, up] = camera.lens.subarray(3 * k, 3 * k + 3);
      const wide = Math.min(width, height * camera.aspect), high = wide / camera.aspect;
      const x = (half * width) / wide, y = ((half / camera.aspect) * height) / high, near = camera.near;
      view.projectionMatrix.makePerspective((right - x) * near, (right + x) * near, (up + y) * near, (up - y) * near, near, FAR);
      view.projectionMatrixInverse.copy(view.projectionMatrix).invert();
      const place = { display: "block", width: wide, height: high, left: (width - wide) / 2, top: (height - high) / 2 };
      for (const [key, value] of Object.entries(place)) gate[key] = typeof value === "number" ? `${value}px` : value;
    }

    /** The shadow map covers the ground around the vehicle, in whole texels, so that edges do not crawl. */
    _placeShadow(view) {
      const centre = this.subject() || this.orbit.target.clone();
      const reach = Math.min(Math.max(3 * view.position.distanceTo(centre), 40), 250);
      const texel = (2 * reach) / this.sun.shadow.mapSize.x;
      const turn = new THREE.Matrix4().lookAt(this.sunward, new THREE.Vector3(), new THREE.Vector3(0, 0, 1));
      const local = centre.applyMatrix4(turn.clone().invert());
      centre.set(Math.round(local.x / texel) * texel, Math.round(local.y / texel) * texel, local.z).applyMatrix4(turn);
      const shadow = this.sun.shadow.camera;
      Object.assign(shadow, { left: -reach, right: reach, top: reach, bottom: -reach, near: 1, far: 1200 });
      shadow.up.set(0, 0, 1);
      shadow.updateProjectionMatrix();
      this.sun.target.position.copy(centre);
      this.sun.position.copy(centre).addScaledVector(this.sunward, 600);
    }

    // ---- controls

    _makeControls() {
      const bar = element("controls");
      bar.replaceChildren();
      const button = (id, text, hint, press) => {
        const made = Object.assign(document.createElement("button"), { id, textContent: text, title: hint });
        if (ICONS[id]) draw(made, id);
        made.addEventListener("click", () => { press(); made.blur(); });
        bar.append(made);
        return made;
      };
      const select = (id, name, options, value, choose) => {
        const label = Object.assign(document.createElement("label"), { textContent: name });
        const made = Object.assign(document.createElement("select"), { id });
        for (const [key, text] of options) made.append(new Option(text, key));
        made.value = value;
        made.addEventListener("change", () => { choose(made.value); made.blur(); });
        label.append(made);
        bar.append(label);
      };
      const toggle = (key, hint) => {
        const made = button(`show-${key}`, key, hint, () => {
          this.shown[key] = !this.shown[key];
          made.setAttribute("aria-pressed", this.shown[key]);
          this.stale = true;
        });
        made.setAttribute("aria-pressed", this.shown[key]);
      };
      button("start", "", "first frame (Home)", () => this.seek(this.first));
      button("back", "", "one frame back (\u2190)", () => this.step(-1));
      button("play", "", "play, pause (Space)", () => this.play());
      button("forward", "", "one frame forward (\u2192)", () => this.step(1));
      button("end", "", "last frame (End)", () => this.seek(this.last));
      const number = Object.assign(document.createElement("input"), { id: "frame", type: "number", min: this.first, max: this.last, title: "frame" });
      number.addEventListener("change", () => { this.seek(Number(number.value) || this.first); number.blur(); });
      bar.append(number);
      const loop = button("loop", "", "play again at the end (L)", () => {
        this.loop = !this.loop;
        loop.setAttribute("aria-pressed", this.loop);
      });
      loop.setAttribute("aria-pressed", this.loop);
      select("speed", "speed", SPEEDS.map((speed) => [speed, `${speed}\u00d7`]), 1, (value) => {
        this.speed = Number(value);
        this.started = { at: performance.now(), frame: this.frame };
      });
      const views = this.cameras.map((camera, k) => [k, camera.name]);
      select("cameras", "view", [[-1, "orbit"], ...views], this.through, (value) => this.lookThrough(Number(value)));
      const followed = this.vehicles.map((name) => [name, name]);
      this.follow = this.vehicles[0] || "";
      select("follow", "follow", [["", "nothing"], ...followed], this.follow, (value) => this._follow(value));
      if (this.curves.length) {
        const names = this.curves.map((curve, k) => [k, this.vehicles.length > 1 ? `${curve.vehicle} ${curve.name}` : curve.name]);
        this.curve = 0;
        select("curve", "curve", names, 0, (value) => { this.curve = Number(value); this.timeline.draw(); });
      } else element("curves").hidden = true;
      bar.append(Object.assign(document.createElement("span"), { className: "space" }));
      toggle("paths", "paths and marks (P)");
      toggle("ghosts", "the vehicles at their marks (G)");
      toggle("cameras", "the shot's cameras (C)");
      button("keys", "?", "keys", () => (element("help").hidden = !element("help").hidden));
      const rows = [...KEYS, ...vehsim.keys].map(([key, what]) => `<tr><td>${key}</td><td>${what}</td></tr>`).join("");
      element("help").innerHTML = `<table>${rows}</table>`;
      this.lookThrough(this.through);
    }

    step(count) {
      this.play(false);
      this.seek(this.frame + count);
    }

    _toMark(sign) {
      const frames = [...this.ticks, ...this.notes].filter((mark) => mark.frame !== null).map((mark) => Math.round(mark.frame)).filter((frame) => sign * (frame - this.frame) > 0);
      if (frames.length) this.seek(sign > 0 ? Math.min(...frames) : Math.max(...frames));
    }

    _listen() {
      const press = {
        " ": () => this.play(), ArrowLeft: (event) => this.step(event.shiftKey ? -10 : -1),
        ArrowRight: (event) => this.step(event.shiftKey ? 10 : 1), Home: () => this.seek(this.first),
        End: () => this.seek(this.last), ",": () => this._toMark(-1), ".": () => this._toMark(1),
        l: () => element("loop").click(), p: () => element("show-paths").click(), g: () => element("show-ghosts").click(),
        c: () => element("show-cameras").click(), f: () => { this.lookThrough(-1); this.frameVehicle(); },
        "?": () => element("keys").click(),
      };
      window.addEventListener("keydown", (event) => {
        if (/^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
        const camera = Number(event.key) - 1;
        if (/^[0-9]$/.test(event.key) && camera < this.cameras.length) this.lookThrough(camera);
        else if (press[event.key.toLowerCase()] || press[event.key]) (press[event.key] || press[event.key.toLowerCase()])(event);
        else return;
        event.preventDefault();
      }, { signal: this.over.signal });
      window.addEventListener("resize", () => { this.stale = true; this.timeline.build(); }, { signal: this.over.signal });
    }
  }

  vehsim.Viewer = Viewer;

  // ---------------------------------------------------------------- the timeline

  class Timeline {
    constructor(viewer) {
      this.viewer = viewer;
      this.track = element("track");
      const scrub = (event) => {
        const box = this.track.getBoundingClientRect();
        viewer.seek(viewer.first + ((event.clientX - box.left) / box.width) * (viewer.last - viewer.first));
      };
      for (const part of [this.track, element("curves")]) {
        part.addEventListener("pointerdown", (event) => {
          viewer.play(false);
          part.setPointerCapture(event.pointerId);
          scrub(event);
        }, { signal: viewer.over.signal });
        part.addEventListener("pointermove", (event) => part.hasPointerCapture(event.pointerId) && scrub(event), { signal: viewer.over.signal });
      }
      this.build();
    }

    /** Ticks at round numbers of frames, and the marks. */
    build() {
      const { first, last, ticks: marks, notes } = this.viewer, length = Math.max(last - first, 1);
      const room = Math.max(this.track.clientWidth / 70, 1);
      const every = [1, 2, 5, 10, 20, 25, 50, 100, 200, 250, 500, 1000, 2000, 5000, 10000].find((n) => length / n <= room) || 20000;
      const at = (frame) => `left:${(100 * (Math.min(Math.max(frame, first), last) - first)) / length}%`;
      let html = "";
      for (let frame = Math.ceil(first / every) * every; frame <= last; frame += every)
        html += `<div class="tick" style="${at(frame)};height:40%"><span>${frame - first < 0.96 * length ? frame : ""}</span></div>`;
      const own = (k) => marks[k].vehicle === (this.viewer.follow || this.viewer.vehicles[0]);
      for (const k of [...marks.keys()].filter((k) => marks[k].frame !== null).sort((a, b) => own(a) - own(b))) // those of the vehicle that is followed on top
        html += `<div class="mark${own(k) ? "" : " other"}" data-mark="${k}" style="${at(marks[k].frame)}"></div>`;
      for (const note of notes) html += `<div class="note" style="${at(note.frame)}"></div>`;
      this.track.innerHTML = `${html}<div class="head"></div>`;
      this.track.querySelectorAll(".note").forEach((note, k) => (note.title = `${notes[k].frame}: ${notes[k].text}`));
      this.track.querySelectorAll(".mark").forEach((mark) => {
        const { vehicle, frame } = marks[mark.dataset.mark];
        mark.title = `${vehicle}: mark at ${frame}`;
      });
      this.draw();
    }

    draw() {
      const { first, last } = this.viewer, frame = this.viewer.live ?? this.viewer.frame;
      const share = (Math.min(frame, last) - first) / Math.max(last - first, 1);
      this.track.querySelector(".head").style.left = `${100 * share}%`;
      if (document.activeElement !== element("frame")) element("frame").value = frame;
      const name = element("title");
      name.innerHTML = "<b></b>";
      name.firstChild.textContent = this.viewer.header.name;
      name.append(`  ${frame}`);
      this._drawCurve(share);
    }

    _drawCurve(share) {
      const canvas = element("curves"), curve = this.viewer.curves[this.viewer.curve];
      if (!curve) return;
      const ratio = window.devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
      canvas.width = width * ratio;
      canvas.height = height * ratio;
      const ink = canvas.getContext("2d");
      ink.scale(ratio, ratio);
      const live = this.viewer.live, before = live === null ? this.viewer.drafted : "before the drive";
      ink.globalAlpha = before ? 0.4 : 1;
      const others = this.viewer.compared.flatMap(({ color, curves }) => curves
        .filter((other) => other.vehicle === curve.vehicle && other.name === curve.name).map(({ values }) => ({ color, values })));
      const every = [curve, ...others].flatMap(({ values }) => [Math.min(...values), Math.max(...values)]);
      let low = Math.min(0, ...every), high = Math.max(0, ...every);
      if (high - low < 1e-9) high = low + 1;
      const place = (value) => height - 4 - ((value - low) / (high - low)) * (height - 8);
      ink.strokeStyle = "#3a3f45";
      ink.strokeRect(0, Math.round(place(0)) + 0.5, width, 0);
      ink.lineWidth = 1.5;
      for (const { color, values } of [...others, { color: "#2fb4ff", values: curve.values }]) {
        ink.beginPath();
        values.forEach((value, k) => ink.lineTo((k / Math.max(values.length - 1, 1)) * width, place(value)));
        ink.strokeStyle = color;
        ink.stroke();
      }
      const near = 0.005 * (high - low); // where a limit binds, the curve has the accent's colour
      const binds = (value) => (curve.high !== null && value >= curve.high - near) || (curve.low !== null && value <= curve.low + near);
      ink.beginPath();
      curve.values.forEach((value, k) => {
        const x = (k / Math.max(curve.values.length - 1, 1)) * width;
        ink[k && binds(value) && binds(curve.values[k - 1]) ? "lineTo" : "moveTo"](x, place(value));
      });
      ink.strokeStyle = "#ff8a3d";
      ink.lineWidth = 3;
      ink.stroke();
      const now = this.viewer._index(live ?? this.viewer.frame), finest = 10 ** (Math.ceil(Math.log10(high - low)) - 4);
      const shown = (values) => `${Number((Math.round(values[now] / finest) * finest).toPrecision(4))} ${curve.unit}`;
      ink.fillStyle = "#fff";
      ink.fillRect(share * width - 0.5, 0, 1, height);
      const name = this.viewer.vehicles.length > 1 ? `${curve.vehicle} ${curve.name}` : curve.name;
      const text = `${name} ${shown(curve.values)}${before && `, ${before}`}`;
      ink.font = "12px system-ui, sans-serif";
      const right = share * width + 8 + ink.measureText(text).width < width;
      ink.textAlign = right ? "left" : "right";
      ink.strokeStyle = "#22252a"; // of the bar, so that curves do not cross the text
      ink.lineWidth = 4;
      [{ color: "#fff", text }, ...others.map(({ color, values }) => ({ color, text: shown(values) }))].forEach((line, k) => {
        ink.fillStyle = line.color;
        const place = [line.text, share * width + (right ? 6 : -6), 14 * (k + 1)];
        ink.strokeText(...place);
        ink.fillText(...place);
      });
    }
  }

  // ---------------------------------------------------------------- water

  class Water {
    constructor(given, array, material, scene) {
      const [rows, cols] = given.shape;
      const { tile, clear, white } = material.userData;
      Object.assign(this, { clear, white });
      this.count = rows * cols;
      this.start = array(given.start);
      this.step = given.step;
      this.foam = array(given.foam);
      this.steps = Int32Array.from(array(given.bends));
      const row = 3 * this.count;
      for (let pass = 0; pass < 2; pass++) // undo the differences
        for (let k = row; k < this.steps.length; k++) this.steps[k] += this.steps[k - row];
      this.geometry = new THREE.BufferGeometry();
      this.place = new THREE.BufferAttribute(new Float32Array(this.start), 3);
      this.colour = new THREE.BufferAttribute(new Float32Array(row), 3);
      this.geometry.setAttribute("position", this.place);
      this.geometry.setAttribute("color", this.colour);
      const uv = new Float32Array(2 * this.count);
      for (let k = 0; k < this.count; k++) {
        uv[2 * k] = this.start[3 * k] / tile;
        uv[2 * k + 1] = this.start[3 * k + 1] / tile;
      }
      this.geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
      this.waves = material.userData.waves && given.waves;
      if (this.waves) {
        this.geometry.setAttribute("water", new THREE.BufferAttribute(new Float32Array(array(given.places)), 4));
        material.userData.carried.value.set(...given.carried);
        this.uniforms = material.userData;
      }
      const faces = [];
      for (let r = 0; r + 1 < rows; r++)
        for (let c = 0; c + 1 < cols; c++) {
          const a = r * cols + c, b = a + cols;
          faces.push(a, a + 1, b + 1, a, b + 1, b);
        }
      this.geometry.setIndex(faces);
      this.mesh = new THREE.Mesh(this.geometry, material);
      this.mesh.frustumCulled = false;
      this.mesh.receiveShadow = true;
      scene.add(this.mesh);
    }

    /** The surface on a frame, or on the last that it has. */
    show(index) {
      const frame = Math.min(index, this.foam.length / this.count - 1);
      const places = this.place.array, colours = this.colour.array, row = 3 * this.count, at = row * frame;
      if (this.waves)
        for (let i = 0; i < this.uniforms.waves.value.length / 4; i++) {
          const [kx, ky, phase, turn, amplitude, only] = this.waves[i] || [1, 0, 0, 0, 0, 0];
          this.uniforms.waves.value.set([kx, ky, (phase - turn * frame) % (2 * Math.PI), only ? -amplitude : amplitude], 4 * i);
        }
      for (let k = 0; k < row; k++) places[k] = this.start[k] + this.step * this.steps[at + k];
      for (let k = 0; k < this.count; k++) {
        const share = this.foam[this.count * frame + k] / 255;
        for (let c = 0; c < 3; c++) colours[3 * k + c] = this.clear[c] + share * (this.white[c] - this.clear[c]);
      }
      this.place.needsUpdate = this.colour.needsUpdate = true;
      this.geometry.computeVertexNormals();
    }
  }

  /** Let a material of water add to its normals the waves that its mesh is too coarse to show, as other pictures do. */
  function addDistantWaves(material, count) {
    const waves = { value: new Float32Array(4 * count) }; // wave vector, phase, height
    const carried = { value: new THREE.Vector2() }; // cells per wave: below the first none of it is in the mesh
    Object.assign(material.userData, { waves, carried });
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, { waves, carried });
      shader.vertexShader = shader.vertexShader
        .replace("#include <common>", "#include <common>\nattribute vec4 water; varying vec4 vWater;")
        .replace("#include <begin_vertex>", "#include <begin_vertex>\nvWater = water;");
      shader.fragmentShader = shader.fragmentShader
        .replace("#include <common>", `#include <common>
          uniform vec4 waves[${count}]; uniform vec2 carried; varying vec4 vWater;`)
        .replace("#include <normal_fragment_maps>", `#include <normal_fragment_maps>
          vec2 slope = vec2(0.0);
          float pixel = max(length(dFdx(vWater.xy)), length(dFdy(vWater.xy)));
          for (int i = 0; i < ${count}; i++) {
            vec2 k = waves[i].xy;
            float size = 6.2831853 / max(length(k), 1e-6);
            float missing = 1.0; // a negative height: the mesh never shows it
            if (waves[i].w > 0.0) missing -= clamp((size / vWater.z - carried.x) / (carried.y - carried.x), 0.0, 1.0);
            float clear = clamp(0.5 * size / pixel - 1.0, 0.0, 1.0); // two to four pixels per wave
            if (missing * clear > 0.0)
              slope -= missing * clear * abs(waves[i].w) * sin(dot(k, vWater.xy) + waves[i].z) * k;
          }
          normal = normalize(normal - vWater.w * (viewMatrix * vec4(slope, 0.0, 0.0)).xyz);`);
    };
  }

  // ---------------------------------------------------------------- tyre marks

  /** A ribbon on the ground, shown as far as it is made. Its edges fade. */
  class TyreMark {
    constructor(given, array, viewer) {
      const ends = array(given.rows), opacity = array(given.opacity), faces = [];
      const across = [0, 0.14, 0.86, 1], full = [0, 1, 1, 0], wide = across.length;
      this.made = array(given.made);
      const rows = this.made.length, places = new Float32Array(3 * wide * rows), colours = new Float32Array(4 * wide * rows);
      for (let r = 0; r < rows; r++)
        for (let c = 0; c < wide; c++) {
          const at = r * wide + c;
          for (let k = 0; k < 3; k++) {
            places[3 * at + k] = ends[6 * r + k] + across[c] * (ends[6 * r + 3 + k] - ends[6 * r + k]);
            colours[4 * at + k] = given.colour[k];
          }
          colours[4 * at + 3] = full[c] * opacity[2 * r];
          if (r + 1 < rows && c + 1 < wide) faces.push(at, at + 1, at + wide, at + 1, at + wide + 1, at + wide);
        }
      this.geometry = new THREE.BufferGeometry();
      this.geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
      this.geometry.setAttribute("color", new THREE.BufferAttribute(colours, 4));
      const up = new Float32Array(places.length).map((_, k) => (k % 3 === 2 ? 1 : 0));
      this.geometry.setAttribute("normal", new THREE.BufferAttribute(up, 3));
      this.geometry.setIndex(faces);
      this.perRow = 6 * (wide - 1);
      const material = new THREE.MeshStandardMaterial({
        vertexColors: true, transparent: true, depthWrite: false, roughness: 0.9, metalness: 0, side: THREE.DoubleSide,
        polygonOffset: true, polygonOffsetFactor: -1, polygonOffsetUnits: -8,
      });
      const mesh = new THREE.Mesh(this.geometry, material);
      mesh.receiveShadow = true;
      viewer.scene.add(mesh);
    }

    show(frame) {
      let rows = this.made.findIndex((when) => when > frame);
      if (rows < 0) rows = this.made.length;
      this.geometry.setDrawRange(0, this.perRow * Math.max(rows - 1, 0));
    }
  }

  // ---------------------------------------------------------------- helpers

  function setPose(matrix, poses, k) {
    const at = 7 * k, unit = setPose.unit || (setPose.unit = new THREE.Vector3(1, 1, 1));
    matrix.compose(
      new THREE.Vector3(poses[at], poses[at + 1], poses[at + 2]),
      new THREE.Quaternion(poses[at + 3], poses[at + 4], poses[at + 5], poses[at + 6]).normalize(),
      unit,
    );
  }

  /** The two sides of an arrow's head at a point on the x axis. */
  const head = (x) => [[x, 0, 0], [x - 0.4, 0.25, 0], [x, 0, 0], [x - 0.4, -0.25, 0]];

  /** Turn the x axis of an object by a heading, and up by a tilt, in degrees; its y axis stays level. */
  function turn(one, heading, tilt) {
    one.rotation.set(0, (-tilt * Math.PI) / 180, (heading * Math.PI) / 180, "ZYX");
  }

  function lines(points) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points.flat()), 3));
    return geometry;
  }

  /** A sphere for a latitude-longitude picture, as USD places it: the pole is the dome's Y, R_wd turns it to world. */
  function skyDome(R) {
    const COLUMNS = 64, ROWS = 32, points = [], uvs = [], faces = [];
    for (let r = 0; r <= ROWS; r++)
      for (let c = 0; c <= COLUMNS; c++) {
        const theta = (Math.PI * r) / ROWS, phi = (2 * Math.PI * c) / COLUMNS - Math.PI / 2;
        const own = [Math.cos(phi) * Math.sin(theta), Math.cos(theta), Math.sin(phi) * Math.sin(theta)];
        points.push(R.map((line) => 10 * (line[0] * own[0] + line[1] * own[1] + line[2] * own[2])));
        uvs.push(c / COLUMNS, 1 - r / ROWS);
      }
    for (let r = 0; r < ROWS; r++)
      for (let c = 0; c < COLUMNS; c++) {
        const a = r * (COLUMNS + 1) + c, b = a + COLUMNS + 1;
        faces.push(a, b, a + 1, b, b + 1, a + 1);
      }
    const geometry = lines(points);
    geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(uvs), 2));
    geometry.setIndex(faces);
    return geometry;
  }

  function dispose(overlay) {
    for (const child of [...overlay.children]) {
      overlay.remove(child);
      if (!child.userData.shared && child.geometry) child.geometry.dispose();
    }
  }
})();
