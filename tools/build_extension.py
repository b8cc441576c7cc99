"""Build the extension for Blender: ``python tools/build_extension.py FOLDER`` writes FOLDER/vehsim-VERSION.zip.

It holds extension/, exporters/blender.py, which makes the curves, and the license. The bytes are the same everywhere.
"""

from __future__ import annotations

import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
DATE = (1980, 1, 1, 0, 0, 0)
"""The earliest that a zip can state."""
MANIFEST = "blender_manifest.toml"
PLACE = "# version:"
"""The line of the manifest that the version replaces."""


def build(folder: Path) -> Path:
    """Write the extension into a folder."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    files = [*sorted((ROOT / "extension").glob("*.py")), ROOT / "exporters" / "blender.py", ROOT / "LICENSE"]
    contents = {file.name: file.read_text(encoding="utf-8") for file in files}
    lines = (ROOT / "extension" / MANIFEST).read_text(encoding="utf-8").splitlines()
    stated = [f'version = "{version}"' if line.startswith(PLACE) else line for line in lines]
    contents[MANIFEST] = "\n".join(stated) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"vehsim-{version}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in contents.items():
            archive.writestr(zipfile.ZipInfo(name, DATE), text)
    return path


if __name__ == "__main__":
    print(build(Path(sys.argv[1])))
