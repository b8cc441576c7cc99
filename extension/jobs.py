"""A command of vehsim that runs beside Blender: its progress, its problems, its end."""

import json
import subprocess
from contextlib import contextmanager

import bpy

from .preferences import environment

PAUSE = 0.25
"""Time between two looks at the process, s."""
AGAIN = "solve it again, if vehicles or files were renamed since"
SHOWN = ("key", "message", "remedy", "severity")
"""The fields of a problem that the panel shows."""
GRACE = 5.0
"""Time in which a cancelled process may clean up, s."""


class Job:
    """A running command. It writes a line of JSON per event to a file, because a pipe that is not read fills up.

    ``what``: for the panel; ``finish``: called with the job when the process has ended well.
    """

    def __init__(self, scene, what, command, folder, finish):
        self._scene, self.what, self.finish = scene.session_uid, what, finish
        self.text, self.share, self.cancelled, self.succeeded = "starting", 0.0, False, False
        folder.mkdir(parents=True, exist_ok=True)
        self._log, self._errors = folder / "log.jsonl", folder / "errors.txt"
        with open(self._log, "w") as log, open(self._errors, "w") as errors:
            self.process = subprocess.Popen(
                command, stdout=log, stderr=errors, stdin=subprocess.DEVNULL, cwd=folder, env=environment()
            )
        self._read = 0  # bytes

    @property
    def scene(self):
        """Found again each time: undo replaces scenes. None if it was deleted."""
        return next((scene for scene in bpy.data.scenes if scene.session_uid == self._scene), None)

    def poll(self):
        """Read what is new; the time until the next look, or None at the end. Blender's timer calls this."""
        ended = self.process.poll() is not None
        with open(self._log, "rb") as log:
            log.seek(self._read)
            whole = log.read().rpartition(b"\n")[0]
        for line in whole.splitlines():
            self._hear(json.loads(line))
        self._read += len(whole) + bool(whole)
        _redraw()
        if not ended:
            return PAUSE
        self._end()
        return None

    def cancel(self):
        self.cancelled, self.text = True, "cancelling"
        self.process.terminate()

    def stop(self):
        """End the process now."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(GRACE)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def _hear(self, event):
        kind = event["event"]
        if kind == "progress":
            self.text, self.share = event["what"], event["done"]
        elif kind == "warning":
            add_problem(self.scene, event.get("problem", {"message": event["message"]}), "warning")
        elif kind == "refused" or (kind == "failed" and "problem" in event):
            add_problem(self.scene, event["problem"], "error")
        elif kind == "failed":
            for problem in event.get("problems") or [{"message": event["message"]}]:
                add_problem(self.scene, problem, "error")

    def _end(self):
        """Show the result, or why there is none."""
        global running
        running = None
        if self.scene is None:
            return
        if self.process.returncode == 0:
            with _shown(self.scene) as window:
                try:
                    self.finish(self)
                    self.succeeded = True
                except Exception as error:  # a timer would only print it
                    add_problem(
                        self.scene, {"message": f"the result cannot be shown: {error}", "remedy": AGAIN}, "error"
                    )
                if window is not None:
                    bpy.ops.ed.undo_push(message=f"vehsim: {self.what}")
        elif not self.cancelled and not any(each.severity == "error" for each in self.scene.vehsim.problems):
            lines = self._errors.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            add_problem(self.scene, {"message": lines[-1] if lines else "vehsim ended without a message"}, "error")
        _redraw()


running = None
"""The job at work, or None. A process cannot be stored in a scene."""


def start(job):
    global running
    running = job
    bpy.app.timers.register(job.poll, first_interval=PAUSE)


@bpy.app.handlers.persistent
def end(*_):
    """End the job at work: another file is opened, or the extension is switched off."""
    global running
    if running is not None:
        if bpy.app.timers.is_registered(running.poll):
            bpy.app.timers.unregister(running.poll)
        running.stop()
        running = None


def add_problem(scene, problem, severity):
    if scene is None:
        return
    fields = {"key": "", "remedy": "", "severity": severity} | problem
    if problem.get("subject"):  # such as the vehicle's name
        fields["message"] = f"{problem['subject']}: {problem['message']}"
    if any(all(getattr(each, name) == fields[name] for name in SHOWN) for each in scene.vehsim.problems):
        return
    shown = scene.vehsim.problems.add()
    for name in SHOWN:
        setattr(shown, name, fields[name])


@contextmanager
def _shown(scene):
    """A context with the scene, as a button has it: a timer has none. Yields its window, or None."""
    window = next((each for each in bpy.context.window_manager.windows if each.scene == scene), None)
    place = {"window": window} if window is not None else {"scene": scene, "view_layer": scene.view_layers[0]}
    with bpy.context.temp_override(**place):
        yield window


def _redraw():
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
