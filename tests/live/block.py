"""Blocks for the page, decoded without vehsim."""

from __future__ import annotations

import json
from typing import Any

import numpy as np


class Block:
    def __init__(self, content: bytes) -> None:
        length = int.from_bytes(content[:4], "little")
        self.header = json.loads(content[4 : 4 + length])
        self.content = content[4 + length :]

    def array(self, ref: dict[str, Any]) -> Any:
        return np.frombuffer(self.content[ref["at"] : ref["at"] + ref["size"]], np.dtype(ref["kind"]))
