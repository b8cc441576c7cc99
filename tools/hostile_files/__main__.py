"""Give thousands of hostile files to the commands of vehsim, and report what a user must never see.

``python -m tools.hostile_files --seeds 0-19999 --out hostile_files``: every seed makes files and runs a command with
them. Finished seeds are listed in ``results.jsonl`` and are not run again, so an interrupted run continues. The folders
of seeds with a finding stay. Findings are: a traceback, an error of vehsim itself, an exit code other than 0, 1 and 2,
more than 20 s of processor time, a process that died, files outside ``--out``, and a good shot that was not delivered.
``--page`` writes them by kind of file, as in ``benchmarks/RESULTS.hostile.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.machine import headed
from tools.seeds import seeds_in

ROOT = Path(__file__).resolve().parents[2]
SLOW = 20.0
"""Processor time, s, from which a command counts as hanging."""
PATIENCE = 1200.0
"""Wall time, s, after which it is ended: a busy machine may take long."""
PAGE = """# Hostile files, measured

`make hostile-files` gives broken and hostile files, made from seeds, to the commands that a user would give them to. A
*finding* is a traceback, an error of vehsim itself, an exit code other than 0, 1 and 2, a command that takes more than
{slow:g} s of CPU time, a process that died, a file outside `--out`, or a good shot of the same command that is not
delivered. *Accepted* files (exit 0) are those whose damage does no harm, or is reported as a warning. Seeds {seeds}.

| kind of file | cases | accepted | refused | findings | CPU, mean s | 99 % | slowest |
|---|---|---|---|---|---|---|---|
"""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0-19999", help="such as 0-99 or 7 or 3,5,8 [default: 0-19999]")
    parser.add_argument("--out", type=Path, default=Path("hostile_files"), help="folder of results")
    parser.add_argument("--again", action="store_true", help="run finished seeds again")
    parser.add_argument("--summary", action="store_true", help="only summarise the results")
    parser.add_argument("--page", type=Path, help="file of Markdown that shows the results by kind")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    results = options.out / "results.jsonl"
    seeds = seeds_in(options.seeds)
    done = {result["seed"] for result in read(results)}
    left = [] if options.summary else [seed for seed in seeds if options.again or seed not in done]
    with results.open("a", encoding="utf-8") as file:
        for result in run(left, options.out):
            file.write(json.dumps(result) + "\n")
            file.flush()
            if result["findings"]:
                print(f"{result['seed']}: {'; '.join(result['findings'])} ({', '.join(result['words'])})", flush=True)
    found = {result["seed"]: result for result in read(results)}  # the last of each seed
    finished = [found[seed] for seed in seeds if seed in found]
    print(summary(finished))
    if options.page:
        options.page.write_text(page(finished, options.seeds), encoding="utf-8")
    return 1 if any(result["findings"] for result in finished) else 0


def read(results: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in results.read_text().splitlines()] if results.is_file() else []


def run(seeds: Sequence[int], out: Path) -> Any:
    """Yield the result of each seed. One process runs them one after another; a new one replaces one that dies."""
    left = list(seeds)
    elsewhere = [out.resolve() / name for name in ("home", "temporary")]
    while left:
        waiting, left = left[:200], left[200:]
        for folder in elsewhere:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        environment = os.environ | {"VEHSIM_CACHE": str(out.resolve() / "cache"), "VEHSIM_CACHE_GB": "0"}
        environment |= {"HOME": str(elsewhere[0]), "TMPDIR": str(elsewhere[1])}
        program = [sys.executable, "-m", "tools.hostile_files.runner", str(out.resolve()), *map(str, waiting)]
        process = subprocess.Popen(program, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment)
        assert process.stdout is not None
        while True:
            watch = threading.Timer(PATIENCE, process.kill)
            watch.start()
            line = process.stdout.readline()
            watch.cancel()
            if not line:
                break
            result = json.loads(line)
            waiting.remove(result["seed"])
            yield result
        code = process.wait()
        if waiting:  # it died of this seed
            what = "no end" if code == -9 else f"the process died with code {code}"
            result = {"seed": waiting.pop(0), "findings": [what], "words": [], "exit": code, "seconds": 0.0}
            yield result
        elif code:
            yield result | {"findings": [*result["findings"], f"the process ends with code {code}"]}
        if strays := sorted(str(path) for folder in elsewhere for path in folder.rglob("*") if not path.is_dir()):
            what = f"files outside --out of this seed or up to 199 before it: {', '.join(strays[:3])}"
            yield result | {"findings": [*result["findings"], what]}
        left = waiting + left
        shutil.rmtree(out / "cache", ignore_errors=True)


def summary(results: Sequence[dict[str, Any]]) -> str:
    exits = Counter(result["exit"] for result in results)
    found = Counter(finding.partition(":")[0] for result in results for finding in result["findings"])
    slow = sorted((result["seconds"] for result in results), reverse=True)[:5]
    lines = [f"{len(results)} cases: {sum(bool(result['findings']) for result in results)} with findings."]
    lines.append("Exit codes: " + ", ".join(f"{code}: {count}" for code, count in sorted(exits.items())) + ".")
    lines.append(f"Longest, processor seconds: {', '.join(f'{seconds:.1f}' for seconds in slow)}.")
    return "\n".join([*lines, *(f"{finding}: {count}" for finding, count in found.most_common())])


def page(results: Sequence[dict[str, Any]], seeds: str) -> str:
    """The results in Markdown: a row for each kind of file, one for all, and every finding."""
    kinds: dict[str, list[dict[str, Any]]] = {}
    for result in results:
        kinds.setdefault(result["words"][0] if result["words"] else "unknown", []).append(result)
    rows = [_row(kind, kinds[kind]) for kind in sorted(kinds)]
    lines = [
        *rows,
        _row("**all**", results),
        "",
        *(f"- {r['seed']}: {'; '.join(r['findings'])}" for r in results if r["findings"]),
    ]
    return headed(PAGE.format(slow=SLOW, seeds=seeds) + "\n".join(lines).rstrip() + "\n")


def _row(kind: str, results: Sequence[dict[str, Any]]) -> str:
    found = sum(bool(r["findings"]) for r in results)
    accepted, refused = (sum(r["exit"] in exits and not r["findings"] for r in results) for exits in ((0,), (1, 2)))
    seconds = sorted(r["seconds"] for r in results)
    times = f"{sum(seconds) / len(seconds):.2f} | {seconds[int(0.99 * (len(seconds) - 1))]:.1f} | {seconds[-1]:.1f}"
    return f"| {kind} | {len(results)} | {accepted} | {refused} | {found} | {times} |"


if __name__ == "__main__":
    raise SystemExit(main())
