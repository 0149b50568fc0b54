"""The shader composer: strict nested includes, line numbers that survive, constants from a representation.

A shader is put together from small files. ``#include "lib/lookup/table.glsl"`` is replaced by the text of that file,
once: later includes of the same file are empty. Names are looked up in the given directories, then in the
library (``shaders/``). The name ``representation`` stands for the file of the representation that is shown,
``environment`` for that of the way in which an environment lights it.
Anything else that looks like an include, an unknown name, a cycle, or an include inside a conditional (which
would hide the file from later includes) is an error, never a silent omission.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from btfref.errors import InputError
from btfref.platform import shader_directory
from btfref.types import PathLike

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation


#: The placeholder name in hosts for the representation's own file.
REPRESENTATION = "representation"

#: The placeholder for the way that an environment lights it; empty where none does.
ENVIRONMENT = "environment"

#: Version lines of the two dialects: desktop OpenGL 3.3 and OpenGL ES 3.0 (WebGL 2).
VERSIONS = {"330 core": "#version 330 core\n", "300 es": "#version 300 es\n"}

#: ES has no default precision for these types in fragment shaders, and lowp for samplers.
ES_PRECISION = (
    "precision highp float;\nprecision highp int;\n"
    "precision highp sampler2DArray;\nprecision highp usampler2DArray;\n"
)

#: What a shader of each dialect begins with.
TARGETS = {"330 core": VERSIONS["330 core"], "300 es": VERSIONS["300 es"] + ES_PRECISION}

_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"\n]+)"\s*(?://.*)?$')
_LOOKS_LIKE_INCLUDE = re.compile(r"^\s*#\s*include\b")
_LINE = re.compile(r"#line (\d+) (\d+)")
_CONDITIONAL = re.compile(r"^\s*#\s*(if|endif)")
_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# "0(12) : error", "0:12(5): error" (Mesa), "ERROR: 0:12:" (glslang)
_LOCATION = re.compile(r"^(\s*(?:ERROR:\s*|WARNING:\s*)?)(\d+)([:(])(\d+)", re.MULTILINE)


class ShaderSource(str):
    """Composed GLSL text; ``files[i]`` is the file that ``#line … i`` refers to."""

    files: tuple[str, ...]

    def explain(self, log: str) -> str:
        """The compiler's messages with file names in place of source-string numbers.

        Parameters
        ----------
        log : str

        Returns
        -------
        str
        """

        def name(match: re.Match[str]) -> str:
            number = int(match[2])
            file = self.files[number] if number < len(self.files) else match[2]
            return f"{match[1]}{file}{match[3]}{match[4]}"

        return _LOCATION.sub(name, log)


def compose(
    name: str,
    defines: Mapping[str, object] | None = None,
    *,
    representation: PathLike | None = None,
    environment: PathLike | None = None,
    directories: Sequence[PathLike] = (),
    target: str = "330 core",
) -> ShaderSource:
    """Put a shader together.

    Parameters
    ----------
    name : str
        File to compose, such as ``"hosts/probe.vert"``.
    defines : dict, optional
        Constants; see :func:`define_block`.
    representation : str or path-like, optional
        The file for ``#include "representation"``: a name in the directories or the library, or a path.
    environment : str or path-like, optional
        The file for ``#include "environment"``; without it that include is empty.
    directories : sequence of path-like
        Searched before the library; for shaders of third-party methods.
    target : {"330 core", "300 es"}

    Returns
    -------
    ShaderSource

    Raises
    ------
    InputError
        For an unknown file or target, a malformed include, or a file that includes itself.
    """
    if target not in TARGETS:
        raise InputError("unknown GLSL target", got=target, expected=" or ".join(TARGETS))
    search = [Path(directory) for directory in directories] + [shader_directory()]
    # File 0 is the text that the composer itself writes.
    files = ["<definitions>"]
    stack: list[Path] = []
    seen: set[Path] = set()

    def expand(included: str, asked_by: str | None) -> list[str]:
        wanted = included
        if included == REPRESENTATION:
            if representation is None:
                raise InputError(
                    "no representation was given for this include", file=asked_by, field=included
                )
            wanted = str(representation)
        if included == ENVIRONMENT:
            if environment is None:
                return []
            wanted = str(environment)
        path = _find(wanted, search, asked_by)
        if path in stack:
            chain = " → ".join([*(p.name for p in stack), path.name])
            raise InputError("a shader includes itself", file=asked_by, got=chain)
        if path in seen:
            return []
        seen.add(path)
        stack.append(path)
        number = len(files)
        files.append(wanted)
        lines, conditionals = [f"#line 1 {number}"], 0
        for position, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            match, where = _INCLUDE.match(line), f"{wanted}:{position}"
            conditional = _CONDITIONAL.match(line)
            if conditional:
                conditionals += 1 if conditional[1] == "if" else -1
            if match and conditionals:
                raise InputError("an include inside a conditional", file=where, got=line.strip())
            if match:
                lines += [*expand(match[1], where), f"#line {position + 1} {number}"]
            elif _LOOKS_LIKE_INCLUDE.match(line):
                raise InputError("malformed include", file=where, got=line.strip(), expected='"…"')
            elif re.match(r"^\s*#\s*version\b", line):
                raise InputError("the composer writes the version line", file=where, got=line.strip())
            else:
                lines.append(line)
        stack.pop()
        return lines

    body = expand(name, None)
    source = ShaderSource(TARGETS[target] + define_block(defines or {}) + "\n".join(body) + "\n")
    source.files = tuple(files)
    return source


def portable(source: ShaderSource) -> str:
    """One text for both dialects, without a version line: whoever compiles it puts one of :data:`VERSIONS` before it.

    Parameters
    ----------
    source : ShaderSource
        Composed for ``330 core``.

    Returns
    -------
    str
        Comments name the files in place of ``#line``, whose numbers mean nothing elsewhere.
    """
    lines = source.removeprefix(TARGETS["330 core"]).splitlines()
    for position, line in enumerate(lines):
        if match := _LINE.fullmatch(line):
            lines[position] = f"// {source.files[int(match[2])]}" if match[1] == "1" else ""
    text = "\n".join(lines)
    return f"#ifdef GL_ES\n{ES_PRECISION}#endif\n{text}\n"


def _find(name: str, search: Sequence[Path], asked_by: str | None) -> Path:
    path = Path(name)
    if path.is_absolute():
        if path.is_file():
            return path.resolve()
    elif ".." not in PurePosixPath(name).parts:
        for directory in search:
            if (directory / name).is_file():
                return (directory / name).resolve()
    raise InputError("unknown shader file", file=asked_by, field="#include" if asked_by else None, got=name)


def define_block(defines: Mapping[str, object]) -> str:
    """``#define`` lines for a dict of constants, names upper-cased.

    Booleans become 0 or 1, floats keep a decimal point (ES has no implicit conversion) and all their digits;
    strings must be identifiers, numbers or plain expressions and stand as they are.

    Parameters
    ----------
    defines : dict of str to bool, int, float or str

    Returns
    -------
    str
        One line a constant, each ended by a newline.

    Raises
    ------
    InputError
        For a name that is no GLSL identifier, a value that is not finite, or one of another type.
    """
    lines = []
    for name, value in defines.items():
        if not _IDENTIFIER.fullmatch(name) or "__" in name or name.lower().startswith("gl_"):
            raise InputError("not a name for a GLSL constant", got=repr(name))
        lines.append(f"#define {name.upper()} {_literal(name, value)}".rstrip() + "\n")
    return "".join(lines)


def _literal(name: str, value: Any) -> str:
    if isinstance(value, str):
        if "\n" in value:
            raise InputError("a GLSL constant spans lines", field=name, got=repr(value))
        return value
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, bool | int):
        return str(int(value))
    if isinstance(value, float):
        if value != value or value in (float("inf"), float("-inf")):
            raise InputError("a GLSL constant is not finite", field=name, got=value)
        return repr(value)
    raise InputError("a GLSL constant of an unsupported type", field=name, got=type(value).__name__)


def representation_defines(rep: Representation) -> dict[str, Any]:
    """Constants that a representation's GLSL file may use.

    For each port array NAME of shape (a, b, …, k): ``NAME_DIM0 a``, ``NAME_DIM1 b``, …, the last one counted
    before the padding to a multiple of 4 where a map of the file has that name; ``NAME_STRIDE``, the RGBA texels of
    one item of the last axis; and every entry of ``rep.meta["constants"]``.

    Parameters
    ----------
    rep : Representation

    Returns
    -------
    dict
    """
    defines: dict[str, Any] = {}
    maps = rep.arrays()
    for name, array in rep.port_arrays().items():
        leading = array.shape[:-1]
        size = maps[name].size if name in maps else array.size
        dimensions = [*leading, size // math.prod(leading)]
        defines |= {f"{name}_DIM{axis}".upper(): int(size) for axis, size in enumerate(dimensions)}
        defines[f"{name}_STRIDE".upper()] = int(array.shape[-1]) // 4
    constants = rep.meta.get("constants", {})
    defines.update({key.upper(): value for key, value in constants.items()})
    return defines
