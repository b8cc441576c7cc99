"""TOML files: plain tables, nested as deeply as a person would, with numbers that a machine holds."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from vehsim.errors import Problem, ShotError

MAX_BYTES = 50_000_000
MAX_DEPTH = 50
"""Tables and arrays inside each other."""
LARGEST = 2**63
"""TOML's whole numbers have 64 bits."""


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """The file's data and text. Raises ``ShotError``."""

    def refuse(message: str, remedy: str) -> ShotError:
        return ShotError([Problem("file", message, remedy, file=str(path))])

    try:
        if path.stat().st_size > MAX_BYTES:
            raise refuse(f"larger than {MAX_BYTES // 1_000_000} MB", "give a smaller file")
        text = path.read_text(encoding="utf-8-sig")
        data = tomllib.loads(text)
    except FileNotFoundError:
        raise refuse("no such file", "give the path of a shot file (.toml)") from None
    except OSError as error:
        raise refuse(f"cannot be read: {error.strerror}", "give the path of a file (.toml)") from None
    except UnicodeDecodeError:
        raise refuse("not UTF-8 text", "save it as UTF-8") from None
    except RecursionError:
        raise refuse("nested too deeply", f"nest at most {MAX_DEPTH} tables and arrays") from None
    except (ValueError, TypeError, AttributeError) as error:  # TOML errors, integers with thousands of digits
        raise refuse(f"not TOML: {error}", "fix the syntax there") from None
    if problem := too_large(data):
        raise ShotError([Problem(problem.key, problem.message, problem.mend, file=str(path))])
    return data, text


def too_large(data: Any) -> Problem | None:
    """What is nested too deeply, or a whole number of more than 64 bits; None for all that can be worked with."""
    left = [("", data, 0)]
    while left:
        key, value, depth = left.pop()
        if depth > MAX_DEPTH:
            key = f"{key[:60]}..." if len(key) > 60 else key
            return Problem(key or "file", "nested too deeply", f"nest at most {MAX_DEPTH} tables and arrays")
        if isinstance(value, dict):
            left += [(f"{key}.{name}".lstrip("."), below, depth + 1) for name, below in value.items()]
        elif isinstance(value, list | tuple):
            left += [(f"{key}[{i}]", below, depth + 1) for i, below in enumerate(value)]
        elif isinstance(value, int) and not -LARGEST <= value < LARGEST:
            return Problem(key or "file", "a whole number of more than 64 bits", "give a smaller number")
    return None
