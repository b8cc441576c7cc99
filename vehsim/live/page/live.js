// The live page: the viewer of the html exporter, fed by a socket, with marks as handles.
"use strict";

(() => {
  const element = (id) => document.getElementById(id);
  const NEAR = 16, SAME = 4; // px
  const LIT = 0xffe066;
  const DEGREES = 180 / Math.PI;
  const STEEPEST = 89 / DEGREES; // a direction that is upright has no heading
  let socket, editor = false, state = null, dragged = null, grips = [], lit = {};

  const panel = document.createElement("aside");
  panel.id = "panel";
  panel.innerHTML = `<div id="watching" hidden>another browser is editing: you are watching</div><div id="buttons"></div><div id="status"></div><div id="bar"><div></div></div><p id="notice" hidden></p><div id="problems"></div>`;
  document.head.append(Object.assign(document.createElement("style"), { textContent: `
    #panel { position: absolute; left: 12px; top: 36px; width: 280px; padding: 8px 10px; border-radius: 6px;
      background: rgba(20, 21, 24, 0.86); }
    #buttons { display: flex; flex-wrap: wrap; gap: 6px; }
    #status { margin-top: 6px; min-height: 1.4em; color: var(--dim); }
    #bar { height: 3px; margin-top: 4px; background: #16181b; } #bar div { height: 100%; width: 0; background: var(--accent); }
    #notice { margin: 6px 0 0; overflow-wrap: anywhere; } #notice.refused { color: var(--accent); }
    #problems p { margin: 6px 0 0; padding-left: 8px; border-left: 2px solid var(--accent); overflow-wrap: anywhere; }
    #problems { max-height: 40vh; overflow: auto; }
    #fold { float: right; margin-left: 6px; } #panel.folded { width: auto; } #panel.folded > :not(#fold) { display: none; }
    button:disabled { opacity: 0.4; cursor: default; }` }));
  const fold = Object.assign(document.createElement("button"), { id: "fold", title: "hide this panel, or show it (H)", textContent: "\u2212" });
  fold.addEventListener("click", () => {
    fold.textContent = panel.classList.toggle("folded") ? "+" : "\u2212";
    fold.blur();
  });
  panel.prepend(fold);
  element("stage").append(panel);

  const status = (text) => (element("status").textContent = text);
  const send = (message) => {
    if (!socket || socket.readyState !== WebSocket.OPEN) return;
    if (message.kind !== "sticks") notice("");
    socket.send(JSON.stringify(message));
  };

  const buttons = {};
  for (const [kind, text, hint] of [
    ["undo", "undo", "Ctrl+Z"], ["redo", "redo", "Ctrl+Shift+Z"], ["save", "save", "Ctrl+S"],
    ["export", "export", "USD and this page, as vehsim export writes them"],
  ]) {
    buttons[kind] = Object.assign(document.createElement("button"), { textContent: text, title: hint, id: `do-${kind}`, disabled: true });
    buttons[kind].addEventListener("click", () => { send({ kind }); buttons[kind].blur(); });
    element("buttons").append(buttons[kind]);
  }

  vehsim.keys.push(
    ["drag a ring", "move a mark or another place; with Shift up and down"], ["drag an arrow", "turn it; a gate's with Shift: tilt it"],
    ["Ctrl Z", "undo; with Shift redo"], ["Ctrl S", "save"], ["H", "hide or show the panel"],
  );

  vehsim.live = { send, status, get editor() { return editor; }, get state() { return state; }, get grips() { return grips; } };

  // ---------------------------------------------------------------- the socket

  vehsim.open = () => {
    vehsim.say("connecting");
    const where = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket${location.search}`;
    socket = new WebSocket(where);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => (typeof event.data === "string" ? told(JSON.parse(event.data)) : shown(event.data));
    socket.onclose = () => {
      status("vehsim has ended; trying to connect again");
      setTimeout(vehsim.open, 1500);
    };
  };

  const CHANGES = { undo: "undo", redo: "redo", save: "changed", export: "solved" }; // button -> what must be true of the state
  const hears = { // kind of message -> what the page does
    role(message) {
      editor = message.editor;
    },
    state(message) {
      state = message;
      if (vehsim.viewer) vehsim.viewer.clearIterates();
      drawHandles();
      element("bar").firstChild.style.width = 0;
      status(`${state.file}${state.changed ? " (not saved)" : ""}: ${state.solved ? "solved" : "not solved"}`);
      list(state.problems);
      if (!vehsim.viewer && state.problems.length) vehsim.say(state.problems.map((one) => one.text).join("\n"));
    },
    progress(message) {
      element("bar").firstChild.style.width = `${100 * message.done}%`;
      status(message.text);
      if (!vehsim.viewer) vehsim.say(message.text);
    },
    drafted: (message) => status(`dragging: solved again in ${Math.round(1000 * message.seconds)} ms`),
    undrawn: (message) => status(`no motion: ${message.text}`),
    said: (message) => notice(message.text, "said"),
    refused: (message) => notice(message.text, "refused"),
  };

  function told(message) {
    if (hears[message.kind]) hears[message.kind](message);
    vehsim.drive.told(message);
    vehsim.edit.told(message);
    element("watching").hidden = editor;
    for (const [kind, needs] of Object.entries(CHANGES)) buttons[kind].disabled = !editor || !state || !state[needs];
  }

  /** Show what was done or refused, until something else is requested. */
  function notice(text, kind) {
    Object.assign(element("notice"), { textContent: text, className: kind, hidden: !text });
  }

  function list(problems) {
    element("problems").replaceChildren(...problems.map(({ text, fixes, offer: set, keeps, restores }) => {
      const shown = Object.assign(document.createElement("p"), { textContent: text });
      const offer = (label, message) => {
        const button = Object.assign(document.createElement("button"), { textContent: label, className: "fix" });
        button.addEventListener("click", () => send(message));
        shown.append(" ", button);
      };
      if (fixes) offer(`set ${set}`, { kind: "fix", fixes });
      if (keeps !== undefined) offer("save the dragged motion as guess", { kind: "keep_dragged", vehicle: keeps });
      if (restores !== undefined) offer("back to the earlier motion", { kind: "restore", vehicle: restores });
      return shown;
    }));
  }

  async function shown(buffer) {
    const { header, array } = vehsim.decode(buffer);
    const viewer = vehsim.viewer;
    if (header.kind === "scene") {
      const made = new vehsim.Viewer(header, array);
      if (viewer) made.replace(viewer);
      else made.lookThrough(-1);
      vehsim.viewer = made;
      told(header); // the buttons that need a scene
      drawHandles();
      made.draw(); // handles are found with the matrices of the last picture
      await made.ready;
      vehsim.say("");
    } else if (!viewer) return; // the scene follows
    else if (header.kind === "live") vehsim.drive.shown(header, array);
    else if (header.kind === "compared") vehsim.drive.compared(header, array);
    else if (header.kind === "motion") {
      viewer.setMotion(header, array);
      drawHandles();
    } else if (header.kind === "water") {
      viewer.setWater(header, array);
    } else if (header.kind === "draft" && (dragged || !editor)) viewer.setDraft(header, array);
    else if (header.kind === "preview") viewer.setDraft(header, array);
    else if (header.kind === "iterate") viewer.setIterate(header, array);
  }

  // ---------------------------------------------------------------- handles

  /** A point in the picture, px. */
  function pixels(point) {
    const box = element("view").getBoundingClientRect(), at = point.clone().project(vehsim.viewer.view);
    if (at.z > 1) return null; // behind the camera
    return { x: box.left + ((at.x + 1) / 2) * box.width, y: box.top + ((1 - at.y) / 2) * box.height };
  }

  function ray(event) {
    const box = element("view").getBoundingClientRect(), caster = new THREE.Raycaster();
    const at = new THREE.Vector2(((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2);
    caster.setFromCamera(at, vehsim.viewer.view);
    return caster.ray;
  }

  const tip = (ring) => new THREE.Vector3(ring.userData.tip, 0, 0).applyMatrix4(ring.matrixWorld);

  /** Pair each handle with its ring: a motion with as many marks draws theirs, all others are drawn here. A drag goes on.
   *  Marks from an artist's prim are shown too, but are no handles. */
  function drawHandles() {
    const viewer = vehsim.viewer;
    if (!viewer || !state) return;
    const marks = state.handles.filter((one) => one.mark !== null), others = state.handles.filter((one) => one.mark === null);
    const given = [...viewer.marks.keys()].filter((k) => state.blocked.includes(viewer.marks[k].vehicle));
    const drawn = [...viewer.marks.keys()].filter((k) => !given.includes(k));
    const same = marks.length === drawn.length; // else the motion on the screen has other marks than the file
    const own = same ? others : [...others, ...marks], rings = viewer.setHandles(own);
    viewer.setNotes(state.notes);
    const placed = marks.map(({ vehicle, frame }, k) => ({ vehicle, frame: frame === null && same ? viewer.marks[drawn[k]].frame : frame }));
    const ticks = [...placed, ...state.unplaced, ...given.map((k) => viewer.marks[k])];
    viewer.setTicks(ticks.map(({ vehicle, frame }) => ({ vehicle, frame })));
    viewer.rings.forEach((ring, k) => (ring.visible = same || given.includes(k)));
    if (same) marks.forEach(({ place, heading }, k) => { // where the file has them, also if it is not solved
      const ring = viewer.rings[drawn[k]], { grounded, position } = viewer.marks[drawn[k]];
      ring.position.copy(viewer.local(place));
      if (grounded) ring.position.z = position[2]; // the file's height counts for nothing
      if (heading !== null) ring.rotation.z = heading / DEGREES;
    });
    grips = same ? marks.map((handle, k) => ({ handle, ring: viewer.rings[drawn[k]], turns: true, solid: [] })) : [];
    grips.push(...own.map((handle, k) => ({ handle, ring: rings[k], turns: handle.turns, solid: solid(handle) })));
    for (const grip of grips) {
      const at = grip.handle.on && grips.find((one) => one.handle.key === grip.handle.on);
      if (at) Object.assign(grip, { at, border: at.ring.userData.carries });
    }
    for (const grip of grips) {
      carry(grip);
      grip.rise = grip.ring.position.z - viewer.local(grip.handle.place).z;
    }
    const now = dragged && dragged.tables === state.tables && grips.find((grip) => grip.handle.key === dragged.handle.key);
    if (!now) {
      dragged = null;
      return;
    }
    now.ring.position.copy(viewer.local(dragged.viewer.world(dragged.ring.position)));
    now.ring.rotation.copy(dragged.ring.rotation);
    Object.assign(dragged, now, { viewer });
    carry(dragged);
  }

  /** The meshes of an obstacle. */
  function solid(handle) {
    const found = [];
    if (handle.obstacle !== null) vehsim.viewer.scene.traverse((one) => {
      if (one.isMesh && one.name.includes(`/obstacles/${handle.obstacle}/`)) found.push(one);
    });
    return found;
  }

  /** Move the meshes of an obstacle from where the scene has them to its ring, and what is at a mark with the mark. */
  function carry({ ring, handle, solid, at, border }) {
    if (at) ring.position.copy(at.ring.position);
    if (border) border.rotation.copy(ring.rotation);
    for (const one of grips) if (one.at && one.at.ring === ring) carry(one);
    const place = vehsim.viewer.local(handle.drawn.place), turn = ring.rotation.z - (handle.drawn.heading || 0) / DEGREES;
    for (const mesh of solid) {
      mesh.rotation.z = turn;
      mesh.position.copy(ring.position).sub(place.clone().applyAxisAngle(mesh.up.set(0, 0, 1), turn));
    }
  }

  /** What is under the pointer: a grip, and whether its arrow was hit. Where several are, marks come first. */
  function under(event) {
    const viewer = vehsim.viewer;
    if (!viewer || !editor || !viewer.shown.paths) return null;
    let best = null;
    for (const grip of grips) for (const turning of [true, false]) {
      if (turning ? !grip.turns : grip.at) continue;
      const at = pixels(turning ? tip(grip.ring) : grip.ring.position);
      const away = at && Math.hypot(at.x - event.clientX, at.y - event.clientY);
      if (at && away < (best ? best.away - SAME : NEAR)) best = { grip, turning, away };
    }
    return best;
  }

  /** Brighten the ring that a press would grab. */
  function light(ring) {
    if (lit.ring === ring) return;
    const paint = (one, colour, over) => { one.material.color.set(colour); one.renderOrder += over; };
    if (lit.ring) paint(lit.ring, lit.colour, -1);
    lit = { ring, colour: ring && ring.material.color.clone() };
    if (ring) paint(ring, LIT, 1); // over others in its place
    vehsim.viewer.stale = true;
  }

  function message(kind) {
    const { ring, handle, turned, tables, rise } = dragged, [x, y, z] = vehsim.viewer.world(ring.position);
    return {
      kind, tables, key: handle.key, position: [x, y, z - rise],
      heading: turned ? ring.rotation.z * DEGREES : null, tilt: turned && handle.tilt !== null ? -ring.rotation.y * DEGREES : null,
    };
  }

  function grab(event) {
    const hit = event.button === 0 && event.target === element("view") && under(event);
    if (!hit) return;
    const { ring } = hit.grip;
    dragged = { ...hit.grip, viewer: vehsim.viewer, tables: state.tables, turning: hit.turning, turned: false, moved: false };
    dragged.plane = new THREE.Plane(new THREE.Vector3(0, 0, 1), -(hit.turning ? tip(ring) : ring.position).z);
    const start = ray(event).intersectPlane(dragged.plane, new THREE.Vector3());
    dragged.grip = start ? ring.position.clone().sub(start) : new THREE.Vector3();
    element("stage").setPointerCapture(event.pointerId);
    vehsim.viewer.play(false);
    event.stopPropagation();
    event.preventDefault();
  }

  function drag(event) {
    if (!dragged) {
      const hit = vehsim.viewer && under(event);
      light(hit && hit.grip.ring);
      element("view").style.cursor = hit ? "grab" : "";
      element("view").title = hit ? hit.grip.handle.key : "";
      return;
    }
    const { ring, plane, grip } = dragged, tilts = dragged.turning && dragged.handle.tilt !== null;
    if (event.shiftKey && (tilts || !dragged.turning)) { // up and down, in the upright plane that faces the camera
      const ahead = vehsim.viewer.view.getWorldDirection(new THREE.Vector3()).setZ(0).normalize();
      const wall = new THREE.Plane().setFromNormalAndCoplanarPoint(ahead, ring.position);
      const hit = ray(event).intersectPlane(wall, new THREE.Vector3());
      if (hit && tilts) tilt(hit.z);
      else if (hit) ring.position.z = hit.z;
      plane.constant = -(tilts ? tip(ring) : ring.position).z;
    } else {
      dragged.lifted = null;
      const hit = ray(event).intersectPlane(plane, new THREE.Vector3());
      if (!hit) return;
      if (dragged.turning) {
        ring.rotation.z = Math.atan2(hit.y - ring.position.y, hit.x - ring.position.x);
        dragged.turned = true;
      } else ring.position.set(hit.x + grip.x, hit.y + grip.y, ring.position.z);
    }
    dragged.moved = true;
    carry(dragged);
    vehsim.viewer.stale = true;
    if (dragged.handle.follows.length && !dragged.waiting) {
      dragged.waiting = true; // at most one message for each picture
      requestAnimationFrame(() => {
        if (!dragged) return;
        dragged.waiting = false;
        send(message("drag"));
      });
    }
    event.stopPropagation();
  }

  /** Raise the tip of the dragged arrow by as much as the pointer, at height z, has risen since Shift is held. */
  function tilt(z) {
    const { ring } = dragged, length = ring.userData.tip * ring.scale.x;
    dragged.lifted ||= { z, sine: -Math.sin(ring.rotation.y) };
    const sine = dragged.lifted.sine + (z - dragged.lifted.z) / length;
    ring.rotation.y = -Math.min(Math.max(Math.asin(Math.min(Math.max(sine, -1), 1)), -STEEPEST), STEEPEST);
    ring.updateMatrixWorld();
    dragged.turned = true;
  }

  function release(event) {
    if (!dragged) return;
    if (dragged.moved) send(message("place"));
    dragged = null;
    event.stopPropagation();
  }

  element("stage").addEventListener("pointerdown", grab, true);
  element("stage").addEventListener("pointermove", drag, true);
  element("stage").addEventListener("pointerup", release, true);
  element("stage").addEventListener("pointercancel", release, true);
  window.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase(), writing = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName);
    if (key === "h" && !writing && !(event.ctrlKey || event.metaKey || event.altKey)) fold.click();
    if (!(event.ctrlKey || event.metaKey) || !["z", "s", "y"].includes(key)) return;
    event.preventDefault();
    send({ kind: key === "s" ? "save" : key === "y" || event.shiftKey ? "redo" : "undo" });
  });
})();
