// Marks on the timeline, and widgets for the shot file's numbers, switches and choices, as the server lists them.
"use strict";

(() => {
  const element = (id) => document.getElementById(id);
  const live = () => vehsim.live;
  let held = null;

  // ---------------------------------------------------------------- marks on the timeline

  function button(id, text, hint, act) {
    const made = Object.assign(document.createElement("button"), { id, textContent: text, title: hint, disabled: true });
    made.addEventListener("click", () => { act(); made.blur(); });
    element("buttons").append(made);
    return made;
  }
  const add = button("do-add", "+ mark", "a mark where the vehicle is at this frame", () =>
    live().send({ kind: "add_mark", vehicle: subject(), frame: vehsim.viewer.frame }));
  const remove = button("do-delete", "\u2212 mark", "delete the mark at this frame", () => {
    const handle = here();
    if (!handle) live().status("no mark at this frame");
    else live().send({ kind: "delete_mark", tables: live().state.tables, vehicle: handle.vehicle, mark: handle.mark });
  });

  const subject = () => vehsim.viewer.follow || vehsim.viewer.vehicles[0];
  /** The marks in the order of the ticks: those with a handle, then those without a place. Ticks of an artist's prim follow. */
  const marks = () => [...live().state.handles.filter((handle) => handle.mark !== null), ...live().state.unplaced];
  const here = () => marks()[vehsim.viewer.ticks.findIndex(({ vehicle, frame }) => vehicle === subject() && frame !== null && Math.round(frame) === vehsim.viewer.frame)];

  const track = element("track");
  const frameAt = (event) => {
    const box = track.getBoundingClientRect(), { first, last } = vehsim.viewer;
    return Math.round(first + ((event.clientX - box.left) / box.width) * (last - first));
  };
  track.addEventListener("pointerdown", (event) => {
    if (!event.target.classList.contains("mark") || !live().editor || !marks()[event.target.dataset.mark]) return;
    held = { k: Number(event.target.dataset.mark), shown: event.target, frame: null, tables: live().state.tables };
    track.setPointerCapture(event.pointerId);
    event.stopImmediatePropagation();
  }, true);
  track.addEventListener("pointermove", (event) => {
    if (!held) return;
    const { first, last } = vehsim.viewer;
    held.frame = frameAt(event);
    held.shown.style.left = `${(100 * (held.frame - first)) / Math.max(last - first, 1)}%`;
    live().status(`mark at frame ${held.frame}`);
    event.stopImmediatePropagation();
  }, true);
  for (const kind of ["pointerup", "pointercancel"]) track.addEventListener(kind, (event) => {
    if (!held) return;
    const { k, frame, tables } = held, handle = marks()[k];
    held = null;
    if (frame === null) vehsim.viewer.seek(vehsim.viewer.ticks[k].frame);
    else if (handle.place) live().send({ kind: "place", tables, key: handle.key, position: handle.place, frame });
    else live().send({ kind: "change", tables, key: handle.key, value: frame });
    event.stopImmediatePropagation();
  }, true);

  // ---------------------------------------------------------------- notes

  const addNote = button("do-note", "+ note", "a note from this frame on", () => {
    fresh = true;
    live().send({ kind: "add_note", frame: vehsim.viewer.frame, text: "note" });
  });
  const notes = Object.assign(document.createElement("div"), { id: "notes" });
  element("panel").append(notes);
  let noted = "", fresh = false;

  /** A row for each note: its frame, its text, a button that pins it to the vehicle's place, and one that deletes it. */
  function listNotes(given, editor) {
    const now = JSON.stringify([given, editor]);
    if (now === noted) return;
    const known = noted ? JSON.parse(noted)[0] : [];
    noted = now;
    notes.replaceChildren(...given.map((one, note) => {
      const row = document.createElement("div"), make = (kind, text, title, act) => {
        const made = Object.assign(document.createElement("button"), { className: kind, textContent: text, title });
        made.addEventListener("click", () => { act(); made.blur(); });
        row.append(made);
        return made;
      };
      make("at", one.frame, "go to this frame", () => vehsim.viewer && vehsim.viewer.seek(one.frame));
      const input = Object.assign(document.createElement("textarea"), { value: one.text, rows: one.text.split("\n").length, maxLength: 1000, disabled: !editor });
      input.addEventListener("change", () => (input.value ? live().send({ kind: "edit_note", tables: live().state.tables, note, text: input.value }) : (input.value = one.text)));
      row.append(input);
      const fit = () => { // as high as its text
        input.style.height = 0;
        input.style.height = `${input.scrollHeight + 2}px`;
      };
      input.addEventListener("input", fit);
      requestAnimationFrame(fit);
      make("pin", "pin", "pin it to where the vehicle is now", () => {
        const place = vehsim.viewer && vehsim.viewer.subject();
        if (place) live().send({ kind: "edit_note", tables: live().state.tables, note, position: vehsim.viewer.world(place) });
      }).disabled = !editor;
      make("drop", "\u00d7", "delete this note", () => live().send({ kind: "delete_note", tables: live().state.tables, note })).disabled = !editor;
      return row;
    }));
    const k = given.findIndex((one, at) => JSON.stringify(one) !== JSON.stringify(known[at]));
    if (fresh && given.length > known.length) {
      fresh = false;
      notes.children[k].querySelector("textarea").select();
    }
  }

  // ---------------------------------------------------------------- settings

  const panel = Object.assign(document.createElement("div"), { id: "settings" });
  document.head.append(Object.assign(document.createElement("style"), { textContent: `
    #panel { max-height: calc(100% - 60px); overflow: auto; }
    #settings summary { cursor: pointer; margin-top: 4px; overflow-wrap: anywhere; }
    #settings label { justify-content: space-between; margin: 3px 0 3px 10px; }
    #settings input[type="number"], #settings select { width: 7.5em; max-width: none; }
    #notes div { display: flex; gap: 4px; margin-top: 4px; } #notes textarea { flex: 1; min-width: 0;
      padding: 3px 5px; font: inherit; color: inherit; background: #2e3238; border: 1px solid var(--line); resize: vertical; }
    #settings .given { color: var(--ink); }
    .fix { margin-left: 4px; border-color: var(--accent); }` }));
  element("panel").append(panel);
  let listed = "";

  /** A group for each table, closed at first; an empty field is the default. */
  function build(settings) {
    const open = new Set([...panel.querySelectorAll("details[open]")].map((one) => one.dataset.table));
    const tables = new Map();
    for (const one of settings) {
      const table = one.key.slice(0, Math.max(one.key.lastIndexOf("."), 0));
      if (!tables.has(table)) tables.set(table, []);
      tables.get(table).push(one);
    }
    panel.replaceChildren(...[...tables].map(([table, fields]) => {
      const group = document.createElement("details");
      group.dataset.table = table;
      group.open = open.has(table);
      const summary = Object.assign(document.createElement("summary"), { textContent: fields[0].table, title: table });
      group.append(summary, ...fields.map(field));
      return group;
    }));
  }

  function field(one) {
    const label = document.createElement("label"), name = one.key.split(".").pop();
    label.title = `${one.key}: ${one.about}`;
    label.append(Object.assign(document.createElement("span"), { textContent: name, className: one.value === null ? "" : "given" }));
    const input = document.createElement(one.kind === "choice" || one.kind === "boolean" ? "select" : "input");
    input.id = `set-${one.key}`;
    if (input.tagName === "SELECT") {
      const choices = one.kind === "boolean" ? ["true", "false"] : one.choices;
      const none = one.default === null ? "" : `(${one.default})`;
      input.append(new Option(none, ""), ...choices.map((choice) => new Option(choice, choice)));
      input.value = one.value === null ? "" : String(one.value);
    } else {
      Object.assign(input, { type: "number", step: one.kind === "integer" ? 1 : "any", placeholder: one.default === null ? "" : one.default });
      if (one.low !== null) input.min = one.low;
      if (one.high !== null) input.max = one.high;
      input.value = one.value === null ? "" : one.value;
    }
    input.disabled = !live().editor;
    input.addEventListener("change", () => {
      const text = input.value;
      const value = text === "" ? null : one.kind === "choice" ? text : one.kind === "boolean" ? text === "true" : Number(text);
      live().send({ kind: "change", tables: live().state.tables, key: one.key, value });
    });
    label.append(input);
    return label;
  }

  function told(message) {
    const { state, editor } = live();
    if (!state) return;
    const now = JSON.stringify([state.settings, editor]);
    if (now !== listed) build(state.settings);
    listed = now;
    listNotes(state.notes, editor);
    addNote.disabled = !(editor && vehsim.viewer);
    add.disabled = remove.disabled = !(editor && vehsim.viewer && marks().length);
  }

  vehsim.edit = { told };
})();
