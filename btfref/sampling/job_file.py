"""A synthesis as a file that workers read: JSON, so that whoever can write into the folder hands over data and no code.

Arrays (geometry, textures, directions) stand in it as base64 of their bytes, little-endian, with type and shape.
"""

from __future__ import annotations

import base64
import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part
from btfref.provenance import __version__
from btfref.sampling.job import Job
from btfref.sampling.paths.adaptive import Plan
from btfref.sampling.settings import SynthesisSettings
from btfref.sampling.store.selection import Selection

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike

#: Key of an array; no key of a BSDF, whose textures are called "array".
_ARRAY = "__array__"


def write_job(path: PathLike, job: Job, only: Selection | None, plan: Plan | None) -> None:
    """Write what a worker needs.

    Parameters
    ----------
    path : path-like
    job : btfref.sampling.job.Job
    only : Selection, optional
    plan : btfref.sampling.paths.adaptive.Plan, optional
    """
    settings = {
        name: getattr(job.settings, name)
        for name in SynthesisSettings.names()
        if name not in ("views", "lights")
    }
    data: Facts = {
        "btfref": __version__,
        "versions": job.attributes["versions"],
        "settings": settings | {"views": job.views.vectors, "lights": job.lights.vectors},
        "names": [job.views.name, job.lights.name],
        "mesostructure": mesostructure_facts(job.mesostructure),
        "only": None if only is None else dataclasses.asdict(only),
        "plan": None if plan is None else dataclasses.asdict(plan),
    }
    write_facts(path, data)


def mesostructure_facts(made: Mesostructure) -> Facts:
    """Geometry and materials, for :func:`write_facts`."""
    return {
        "name": made.name,
        "parameters": made.parameters,
        "ignored": made.ignored,
        "parts": [
            {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
            for part in made.parts
        ],
    }


def mesostructure_of(made: Facts) -> Mesostructure:
    """The mesostructure whose :func:`mesostructure_facts` these are."""
    parts = tuple(Part(**part) for part in made["parts"])
    return Mesostructure(made["name"], made["parameters"], parts, tuple(made["ignored"]))


def write_facts(path: PathLike, data: Facts) -> None:
    """Write facts with arrays among them."""
    Path(path).write_text(json.dumps(data, default=_packed), "utf-8")


def read_facts(path: PathLike) -> Facts:
    """What :func:`write_facts` wrote.

    Raises
    ------
    InputError
        Of another version of btfref.
    ValueError, KeyError
        Not such a file.
    """
    data = json.loads(Path(path).read_text("utf-8"), object_hook=_unpacked)
    if data["btfref"] != __version__:
        raise InputError(
            "a worker of another version", field="btfref", got=__version__, expected=data["btfref"]
        )
    return data


def refuse_other_versions(attributes: Facts, told: Facts) -> None:
    """InputError where a job was made with other versions than this process has."""
    if attributes["versions"] != told["versions"]:
        raise InputError(
            "a worker of another version",
            field="versions",
            got=attributes["versions"],
            expected=told["versions"],
        )


def read_job(path: PathLike) -> tuple[Job, Selection | None, Plan | None]:
    """The job of a file.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    job : btfref.sampling.job.Job
    only : Selection or None
    plan : btfref.sampling.paths.adaptive.Plan or None

    Raises
    ------
    InputError
        Not such a file, or one of another version than this process's libraries.
    """
    try:
        data = read_facts(path)
        mesostructure = mesostructure_of(data["mesostructure"])
        settings = SynthesisSettings(**data["settings"])
        only = data["only"] and Selection(**data["only"])
        plan = data["plan"] and Plan(**data["plan"])
        names = data["names"]
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("not the job of a synthesis", file=path, got=error) from error
    job = Job(mesostructure, {}, settings)
    refuse_other_versions(job.attributes, data)
    job.views, job.lights = (
        dataclasses.replace(directions, name=name)
        for directions, name in zip((job.views, job.lights), names, strict=True)
    )
    return job, only or None, plan or None


def _packed(value: Any) -> object:
    if isinstance(value, np.ndarray):
        little = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        return {
            _ARRAY: base64.b64encode(little.tobytes()).decode(),
            "type": little.dtype.str,
            "shape": value.shape,
        }
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


def _unpacked(data: dict[str, Any]) -> Any:
    if _ARRAY not in data:
        return data
    # No object arrays: their bytes would be a pickle.
    dtype = np.dtype(data["type"])
    if dtype.kind not in "fiub":
        raise ValueError(f"type {dtype} of an array")
    return np.frombuffer(base64.b64decode(data[_ARRAY]), dtype).reshape(data["shape"]).copy()
