"""Export random shots, and measure the deliveries with a verifier that does not use vehsim.

``python -m tools.audit_random --seeds 0-999 --out audit_random``: every seed has its own folder with the shot, the
delivery and ``result.json``; finished ones are skipped, so that an interrupted run continues where it stopped.
``--again`` verifies existing deliveries again. A summary is printed and written to ``summary.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tools.audit_random.shots import make_shot, write_shot
from tools.seeds import seeds_in

HERE = Path(__file__).resolve().parent
DELIVERY = "out"
OVERRULED = ("misses what was requested", "misses requests")
"""What vehsim says where its audit refuses a motion or a stage that was solved."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0-999", help="such as 0-99 or 7 or 3,5,8 [default: 0-999]")
    parser.add_argument("--out", type=Path, default=Path("audit_random"), help="folder of results")
    parser.add_argument("--seconds", type=float, default=300.0, help="time limit of one shot")
    parser.add_argument("--only", default="", help="shots with one of these words, such as hold,loop")
    parser.add_argument("--without", default="", help="shots without any of these words, such as canyon,map")
    parser.add_argument("--again", action="store_true", help="verify finished deliveries once more; export nothing")
    parser.add_argument("--keep", action="store_true", help="keep deliveries that were not refuted")
    parser.add_argument("--summary", action="store_true", help="only sum up what is there")
    options = parser.parse_args(arguments)
    only, without = (set(filter(None, words.split(","))) for words in (options.only, options.without))
    for seed in () if options.summary else seeds_in(options.seeds):
        words = set(make_shot(seed).words)
        if (only and not words & only) or words & without:
            continue
        folder = options.out / str(seed)
        done = (folder / "result.json").is_file()
        if options.again and not (folder / DELIVERY).is_dir():
            continue
        if done and not options.again:
            continue
        result = (
            _verified(json.loads((folder / "result.json").read_text()), folder)
            if done
            else run_shot(seed, folder, options.seconds)
        )
        if not (options.keep or result["refuted"]):
            shutil.rmtree(folder / DELIVERY, ignore_errors=True)
        print(_line(seed, result), flush=True)
    results = {int(file.parent.name): json.loads(file.read_text()) for file in options.out.glob("*/result.json")}
    text = summary(results)
    (options.out / "summary.md").write_text(text, encoding="utf-8")
    print(text)
    return 1 if any(result["refuted"] for result in results.values()) else 0


def run_shot(seed: int, folder: Path, seconds: float) -> dict[str, Any]:
    """Export one shot in a separate process, verify it in another, and write ``result.json``."""
    shutil.rmtree(folder, ignore_errors=True)
    draft = make_shot(seed)
    shot = write_shot(draft, folder)
    command = [sys.executable, "-m", "vehsim", "export", str(shot), "--out", str(folder / DELIVERY), "--to", "usd"]
    start, used = time.monotonic(), _processor_seconds()
    try:
        environment = os.environ | {"PYTHONPATH": str(HERE.parents[1])}
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, env=environment)
        code, output = done.returncode, (done.stdout + done.stderr).strip()
    except subprocess.TimeoutExpired:
        code, output = 124, f"no end after {seconds:g} s"
    result = {
        "seed": seed,
        "version": version(),
        "words": draft.words,
        "asset": draft.table["vehicle"][-1]["asset"],
        "exit": code,
        "seconds": round(time.monotonic() - start, 2),
        "processor_seconds": round(_processor_seconds() - used, 2),
        "said": output[-2000:],
        "refuted": [],
        "overruled": code != 0 and any(text in output for text in OVERRULED),
    }
    return _verified(result, folder)


def _processor_seconds() -> float:
    """CPU seconds used by finished child processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def version() -> str:
    """The measured commit, if git knows it."""
    command = ["git", "-C", str(HERE), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True).stdout.strip()


def _verified(result: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The result, with everything in its delivery that a verifier in another process refutes, written beside the
    shot."""
    if result["exit"] == 0:
        stage = next((folder / DELIVERY).glob("*/*.usda"))
        command = [sys.executable, str(HERE / "verify.py"), str(folder / "shot.toml"), str(stage), "--json"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode not in (0, 1):
            result |= {"refuted": [{"ask": "verifier", "text": done.stderr[-1500:]}], "checks": {}}
        else:
            result |= json.loads(done.stdout)
            if "warning: " in result["said"]:  # a miss that a pilot has reported as a warning is not a false promise
                result["refuted"] = [row for row in result["refuted"] if row["ask"] != "pilot"]
    (folder / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return result


def summary(results: dict[int, dict[str, Any]]) -> str:
    """The number of solved shots and of refuted successes, by how much they were refuted, and a table by family."""
    solved = [r for r in results.values() if r["exit"] == 0]
    refuted = {seed: r for seed, r in sorted(results.items()) if r["refuted"]}
    checks: Counter[str] = Counter()
    failed: Counter[str] = Counter()
    worst: dict[str, dict[str, Any]] = {}
    for r in solved:
        checks.update(r.get("checks", {}))
        failed.update({row["ask"] for row in r["refuted"]})
        worst |= {row["ask"]: _worse(worst.get(row["ask"]), row) for row in r["refuted"]}
    lines = [f"{len(results)} shots: {len(solved)} delivered, {len(refuted)} of them refuted."]
    lines.append(f"{sum(r.get('overruled', False) for r in results.values())} times vehsim's own audit overruled.")
    exits = Counter(r["exit"] for r in results.values())
    lines.append("Exit codes: " + ", ".join(f"{code}: {count}" for code, count in sorted(exits.items())) + ".")
    lines += ["", "| ask | measured | shots refuted | worst |", "|---|---|---|---|"]
    for ask, count in sorted(checks.items()):
        lines.append(f"| {ask} | {count} | {failed[ask]} | {worst[ask]['text'] if ask in worst else ''} |")
    lines += ["", "| family | shots | delivered | refuted |", "|---|---|---|---|"]
    for family, rows in sorted(_families(results.values()).items()):
        delivered = sum(r["exit"] == 0 for r in rows)
        lines.append(f"| {family} | {len(rows)} | {delivered} | {sum(bool(r['refuted']) for r in rows)} |")
    for seed, r in refuted.items():
        lines += ["", f"seed {seed} ({', '.join(r['words'])}):", *(f"- {row['text']}" for row in r["refuted"][:6])]
    return "\n".join(lines) + "\n"


def _worse(one: dict[str, Any] | None, other: dict[str, Any]) -> dict[str, Any]:
    """Of two refutations of the same ask, the one farther beyond its bound."""
    return other if one is None or other["value"] - other["bound"] > one["value"] - one["bound"] else one


def _families(results: Iterable[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    families = defaultdict(list)
    for result in results:
        for word in result["words"]:
            families[word].append(result)
        families[f"{result['words'][0]}, {result['asset']}"].append(result)
    return families


def _line(seed: int, result: dict[str, Any]) -> str:
    verdict = "refuted" if result["refuted"] else "delivered" if result["exit"] == 0 else f"exit {result['exit']}"
    why = result["refuted"][0]["text"] if result["refuted"] else "" if result["exit"] == 0 else result["said"][-160:]
    return f"{seed}: {verdict} in {result['seconds']} s ({', '.join(result['words'])}) {why}"


if __name__ == "__main__":
    raise SystemExit(main())
