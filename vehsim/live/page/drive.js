// A vehicle is driven: keys, sticks on the screen and gamepads move one stick for each control, from -1 to 1.
// Forward and left are positive. The first two controls are one pad, the next two another, as on a gamepad.
"use strict";

(() => {
  const element = (id) => document.getElementById(id);
  const KEYS = { // event.code is the place of a key, on any layout
    KeyW: [0, 1], KeyS: [0, -1], KeyA: [1, 1], KeyD: [1, -1],
    ArrowUp: [2, 1], ArrowDown: [2, -1], ArrowLeft: [3, 1], ArrowRight: [3, -1],
  };
  const HINTS = ["W S", "A D", "\u2191 \u2193", "\u2190 \u2192"];
  const AXES = [1, 0, 3, 2]; // of a gamepad, for each control; forward and left are negative there
  const RAMP = 4; // per s: a held key moves its stick to the end in a quarter of a second
  const DEAD = 0.08;
  const held = new Set();
  let driven = null, values = [], keyed = [], pads = [], sent = "", before = 0;

  const panel = document.createElement("div");
  panel.id = "pads";
  panel.hidden = true;
  document.head.append(Object.assign(document.createElement("style"), { textContent: `
    #pads { position: absolute; left: 0; right: 0; bottom: 16px; display: flex; justify-content: center; gap: 40px;
      pointer-events: none; }
    .pad { position: relative; width: 120px; height: 120px; border-radius: 12px; background: rgba(20, 21, 24, 0.6);
      border: 1px solid var(--line); touch-action: none; user-select: none; pointer-events: auto; cursor: grab; }
    .pad i { position: absolute; left: 50%; top: 50%; width: 28px; height: 28px; margin: -14px; border-radius: 50%;
      background: var(--accent); pointer-events: none; }
    .pad span { position: absolute; left: 0; right: 0; text-align: center; font-size: 11px; color: var(--ink); }
    .pad span:nth-of-type(1) { top: 3px; } .pad span:nth-of-type(2) { bottom: 3px; }
    #recordings div { display: flex; gap: 6px; align-items: center; margin-top: 4px; }
    #recordings label { flex: 1; min-width: 0; overflow-wrap: anywhere; }
    #recordings i { width: 10px; height: 10px; border-radius: 50%; }` }));
  element("stage").append(panel);

  function button(id, text, hint, act) {
    const made = Object.assign(document.createElement("button"), { id, textContent: text, title: hint, disabled: true });
    made.addEventListener("click", () => { act(); made.blur(); });
    element("buttons").append(made);
    return made;
  }
  const start = button("do-drive", "drive", "take the controls from the first frame; again or Esc to stop", () => (driven ? stop() : drive(null)));
  const on = button("do-drive-on", "drive on", "continue the recording from the frame that is shown", () => drive(vehsim.viewer.frame));

  const offered = () => {
    const drives = (vehsim.live.state && vehsim.live.state.drives) || [];
    return drives.find((one) => vehsim.viewer && one.vehicle === vehsim.viewer.follow) || drives[0];
  };
  const drive = (frame) => vehsim.live.send({ kind: "drive", vehicle: offered().vehicle, frame });
  const stop = () => vehsim.live.send({ kind: "stop" });

  // ---------------------------------------------------------------- recordings side by side

  const recordings = Object.assign(document.createElement("div"), { id: "recordings" });
  element("panel").insertBefore(recordings, element("notes"));
  let listed = "";

  /** A row for each recording beside the shot: whether it is drawn, its colour, its name, and a button that uses it. */
  function listRecordings(given, editor) {
    const colours = Object.fromEntries((vehsim.viewer ? vehsim.viewer.compared : []).map((one) => [one.name, one.color]));
    const now = JSON.stringify([given, editor, colours]);
    if (now === listed) return;
    listed = now;
    recordings.replaceChildren(...given.map((one) => {
      const row = document.createElement("div"), label = document.createElement("label");
      const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: one.compared, disabled: !editor, title: "draw it beside the present motion" });
      box.addEventListener("change", () => {
        const chosen = given.filter((other) => (other === one ? box.checked : other.compared));
        vehsim.live.send({ kind: "compare", files: chosen.map((other) => other.name) });
      });
      label.append(box, ` ${one.name}`);
      const colour = document.createElement("i");
      colour.style.background = colours[one.name] || "";
      const use = Object.assign(document.createElement("button"), { textContent: one.used ? "in use" : "use", title: "make it the vehicle's motion", disabled: !editor || one.used || !one.usable });
      use.addEventListener("click", () => vehsim.live.send({ kind: "use_recording", file: one.name }));
      row.append(label, colour, use);
      return row;
    }));
  }

  function compared(header, array) {
    vehsim.viewer.setCompared(header, array);
    listRecordings(vehsim.live.state ? vehsim.live.state.recordings : [], vehsim.live.editor);
  }

  // ---------------------------------------------------------------- what the server says

  function told(message) {
    if (message.kind === "driving") begin(message.vehicle);
    if (message.kind === "driven") end();
    if (vehsim.live.state) listRecordings(vehsim.live.state.recordings, vehsim.live.editor);
    const one = offered(), ready = vehsim.live.editor && one && vehsim.live.state.solved;
    start.textContent = driven ? "stop" : "drive";
    start.disabled = !ready;
    on.disabled = !ready || !one.continues || Boolean(driven);
  }

  function shown(header, array) {
    if (!driven) return;
    vehsim.viewer.setLive(header, array);
    const late = header.behind ? `; the simulation is ${header.behind} s late` : "";
    vehsim.live.status(`driving ${header.vehicle}: frame ${Math.floor(header.frame)}${late}`);
  }

  function begin(vehicle) {
    driven = vehsim.live.state.drives.find((one) => one.vehicle === vehicle);
    values = driven.controls.map(() => 0);
    keyed = [...values];
    sent = "";
    vehsim.viewer.play(false);
    vehsim.live.status("preparing the simulation");
    if (!vehsim.live.editor) return;
    pads = Array.from({ length: Math.ceil(values.length / 2) }, (_, k) => pad(k));
    panel.replaceChildren(...pads.map((one) => one.box));
    panel.hidden = false;
    tick();
  }

  function end() {
    driven = null;
    held.clear();
    panel.hidden = true;
    if (vehsim.viewer) vehsim.viewer.endLive();
  }

  // ---------------------------------------------------------------- sticks

  /** A square with a knob: control 2 k is up and down, the next one left and right. */
  function pad(k) {
    const box = document.createElement("div"), knob = document.createElement("i"), made = { box, knob, at: [0, 0] };
    box.className = "pad";
    box.append(knob, ...[2 * k, 2 * k + 1].map((c) => Object.assign(document.createElement("span"),
      { textContent: c < values.length ? `${driven.controls[c]}  ${HINTS[c] || ""}` : "" })));
    const grab = (event) => {
      if (!box.hasPointerCapture(event.pointerId)) return;
      const { left, top, width, height } = box.getBoundingClientRect();
      made.at = [1 - (2 * (event.clientY - top)) / height, 1 - (2 * (event.clientX - left)) / width];
    };
    box.addEventListener("pointerdown", (event) => { event.stopPropagation(); box.setPointerCapture(event.pointerId); grab(event); });
    box.addEventListener("pointermove", grab);
    for (const kind of ["pointerup", "pointercancel"]) box.addEventListener(kind, () => (made.at = [0, 0]));
    return made;
  }

  /** Move the sticks, and send them if they have moved. */
  function tick() {
    if (!driven) return;
    setTimeout(tick, 1000 / 60); // not with the pictures, which a slow machine draws seldom
    const now = performance.now();
    const most = RAMP * Math.min((now - (before || now)) / 1000, 1 / RAMP), game = gamepad(); // a slow page too
    before = now;
    values = values.map((_, c) => {
      let wanted = 0;
      for (const code of held) if (stick(code) === c) wanted += KEYS[code][1];
      keyed[c] += Math.min(Math.max(wanted - keyed[c], -most), most);
      const [padded, axis] = [pads[c >> 1].at[c & 1], game ? -game.axes[AXES[c]] || 0 : 0];
      return Math.min(Math.max(keyed[c] + padded + (Math.abs(axis) > DEAD ? axis : 0), -1), 1);
    });
    pads.forEach((one, k) => {
      one.knob.style.transform = `translate(${-46 * (values[2 * k + 1] || 0)}px, ${-46 * values[2 * k]}px)`;
    });
    if (String(values) === sent) return;
    sent = String(values);
    vehsim.live.send({ kind: "sticks", values });
  }

  /** The control of a key; the arrows serve the first pad if there is only one. */
  const stick = (code) => (values.length > 2 ? KEYS[code][0] : KEYS[code][0] % 2);
  const gamepad = () => [...(navigator.getGamepads ? navigator.getGamepads() : [])].find((one) => one && one.axes.length > 1);

  function press(event) {
    if (!driven || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code === "Escape" && event.type === "keydown") stop();
    else if (!KEYS[event.code]) return;
    else if (event.type === "keydown") held.add(event.code);
    else held.delete(event.code);
    event.preventDefault();
    event.stopImmediatePropagation(); // the timeline has the arrows otherwise
  }
  window.addEventListener("keydown", press, true);
  window.addEventListener("keyup", press, true);
  window.addEventListener("blur", () => held.clear()); // its key-up would never come

  vehsim.drive = { told, shown, compared, get values() { return values; }, get driven() { return driven; } };
})();
