"""A port package as a folder that stands for itself: shader, textures, known answers, and examples of hosts."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.outputs import new_folder
from btfref.rendering.ports.ktx2 import ktx2
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.rendering.ports.answers import KnownAnswers
    from btfref.rendering.ports.package import PortPackage

#: ``{{name}}`` in a template, in files whose language has comments as one.
_BLANK = re.compile(r"(?://)?\{\{(\w+)\}\}")


def webgl_script() -> str:
    """The JavaScript that reads packages: an object ``BtfPort``."""
    return files(__package__).joinpath("webgl2.js").read_text("utf-8")


def write_folder(package: PortPackage, answers: KnownAnswers, folder: PathLike) -> Facts:
    """Write a package, its answers, and what shows how to use them.

    Parameters
    ----------
    package : btfref.rendering.ports.package.PortPackage
    answers : btfref.rendering.ports.answers.KnownAnswers
    folder : path-like
        Made; nothing is left of it when something goes wrong.

    Returns
    -------
    dict
        ``textures``, ``probes``: how many; ``bytes``: of the textures; ``needs``: of a device.

    Raises
    ------
    InputError
        For a folder that is there already, or none to make it in.
    """
    probes = answers.to_dict()
    words = {
        "script": webgl_script(),
        "package": _in_html(package.embedded()),
        "probes": _in_html(probes),
        "n": str(len(answers.rows)),
        "needs": package.needs,
        "rows": str(package.facts["texels"][0]),
        "columns": str(package.facts["texels"][1]),
        "title": package.facts["title"],
        "paper": package.facts["paper"],
    }
    with new_folder(folder) as draft:
        package.write_into(draft)
        for texture in package.textures:
            (draft / "textures" / f"{texture.name}.ktx2").write_bytes(ktx2(texture))
        (draft / "probes.json").write_text(json.dumps(probes) + "\n", encoding="utf-8")
        _fill(files(__package__).joinpath("templates"), draft, words)
    return {
        "format": "gl",
        "method": package.facts["method"],
        "textures": len(package.textures),
        "bytes": package.nbytes,
        "probes": len(answers.rows),
        "needs": package.needs,
    }


def _fill(template: Traversable, folder: Path, words: dict[str, str]) -> None:
    """Templates as files of a folder, with the blanks filled in."""
    for one in template.iterdir():
        if one.is_dir():
            (folder / one.name).mkdir()
            _fill(one, folder / one.name, words)
        else:
            text = _BLANK.sub(lambda found: words[found[1]], one.read_text("utf-8"))
            # A program of Python bears another name here: it is no module of ours.
            (folder / one.name.removesuffix(".template")).write_text(text, encoding="utf-8")


def _in_html(facts: Facts) -> str:
    """JSON that may stand in an element ``script``."""
    return json.dumps(facts).replace("<", "\\u003c")
