"""What is looked up by name: the methods, one row each, as strings, so that nothing is imported before it is used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from btfref.errors import BtfrefError, InputError
from btfref.registry.points import (
    ENTRY_POINT_GROUP,
    GROUPS,
    BrokenPoint,
    imported,
    one_line,
    packages_of,
    usable_points,
)

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike


@dataclass(frozen=True)
class Method:
    """Where the parts of a method are.

    Parameters
    ----------
    key : str
        Name on the command line, in files and in shaders.
    title, paper : str
        For people.
    module : str
        Module with ``Representation`` (the class) and, unless ``fit_module`` has them, ``fit`` and ``PRESETS``.
    plugin : str
        Module with ``Evaluator``, the Dr.Jit port.
    shader : str
        GLSL file with ``btf_eval``, relative to a shader directory.
    shader_package : str
        Package that holds the shader directory ("" for btfref's own).
    image_light : str
        ``module:class`` of the prefiltered path for environments, as in
        :mod:`btfref.rendering.environment_light.image_light`; "" if the method has none.
    fit_module : str
        Module with ``fit`` and ``PRESETS``; "" if that is ``module``.
    editing : str
        Module with ``export_maps(representation, folder)`` and ``import_maps(folder)``, for a method whose maps are
        made for editing; "" if they are not.
    """

    key: str
    title: str
    paper: str
    module: str
    plugin: str
    shader: str
    shader_package: str = ""
    image_light: str = ""
    fit_module: str = ""
    editing: str = ""

    def _part(self, module: str) -> ModuleType:
        """A module of the method; what it fails at is said with the method's name."""
        try:
            return import_module(module)
        except Exception as error:
            if not module.startswith(("btfref.", "mitsuba_plugins.")):
                raise BtfrefError(
                    f"the method '{self.key}' cannot be loaded: {module}: {one_line(error)}"
                ) from error
            raise

    @property
    def representation(self) -> type[Any]:
        """The class that holds the method's maps and evaluates them in float64."""
        return self._part(self.module).Representation

    @property
    def fitting(self) -> ModuleType:
        """The module that makes representations: a :class:`btfref.representations.protocol.FitModule`."""
        return self._part(self.fit_module or self.module)

    @property
    def evaluator(self) -> type[Any]:
        """The Dr.Jit port, of the current Mitsuba variant."""
        return self._part(self.plugin).Evaluator

    @property
    def fit(self) -> Callable[..., Any]:
        """``fit(btf, *, seed=0, progress=None, **params) -> Representation``."""
        return self.fitting.fit

    def quick_fit(self, btf: Any, **parameters: Any) -> Any:
        """``fit`` with the preset "quick" where the method has one: for checks that make many fits."""
        return self.fit(btf, **self.presets.get("quick", {}) | parameters)

    @property
    def presets(self) -> dict[str, Facts]:
        """Named settings of ``fit``; "paper": those of the method's paper; "quick": what checks take for their fits."""
        return self.fitting.PRESETS

    @property
    def tolerances(self) -> Path | None:
        """Where the method's own limits stand, if it has any: ``tolerances.toml`` beside its module.

        None for a module that is in no package. Nothing of the method is imported.
        """
        top, *inner = self.module.split(".")[:-1] or [""]
        spec = find_spec(top) if top else None
        roots = spec.submodule_search_locations if spec else None
        return Path(roots[0], *inner, "tolerances.toml") if roots else None

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters of ``fit`` that are the method's own, with their defaults."""
        found = signature(self.fit).parameters.values()
        return {p.name: p.default for p in found if p.name not in ("btf", "seed", "progress")}

    def settings(self, preset: str | None, given: dict[str, Any]) -> dict[str, Any]:
        """Parameters of a fit: those of a preset, overridden by the given ones.

        Raises
        ------
        InputError
            For a preset or a parameter that the method does not have.
        """
        if preset is not None and preset not in self.presets:
            raise InputError(
                f"{self.key} has no such preset",
                field="preset",
                got=repr(preset),
                expected=f"one of {', '.join(self.presets)}",
            )
        known = self.parameters
        for name in given:
            if name not in known:
                raise InputError(
                    f"{self.key} has no such parameter",
                    field="parameter",
                    got=repr(name),
                    expected=f"one of {', '.join(known)}" if known else "none",
                )
        return (self.presets[preset] if preset is not None else {}) | given

    @property
    def editor(self) -> ModuleType:
        """The module that writes maps as pictures for editing and reads them back."""
        return self._part(self.editing)


def _row(
    key: str,
    title: str,
    paper: str,
    module: str,
    *,
    ports: str | None = None,
    image_light: str | None = None,
    fit: str | None = None,
    editing: str | None = None,
) -> Method:
    """A row of btfref's own; ``ports`` names the method whose ports evaluate the same maps."""
    return Method(
        key,
        title,
        paper,
        module=f"btfref.representations.{module}",
        plugin=f"mitsuba_plugins.{ports or key}",
        shader=f"representations/{ports or key}.glsl",
        image_light=f"btfref.rendering.environment_light.image_light:{image_light}" if image_light else "",
        fit_module=f"btfref.representations.{fit}" if fit else "",
        editing=f"btfref.representations.{editing}" if editing else "",
    )


_ROWS = (
    _row("raw", "Tabulated BTF, interpolated", "Dana et al. 1999", "tabulated.raw"),
    _row("svd", "Global truncated singular value decomposition", "Koudelka et al. 2003", "tabulated.svd"),
    _row(
        "lpca", "Local PCA (eigen-BRDFs per cluster)", "Müller, Meseth, Klein 2003 and 2004", "tabulated.lpca"
    ),
    _row("laplacian", "Laplacian pyramid, components per level", "Ma et al. 2005", "laplacian.definition"),
    _row(
        "rf_poly",
        "Reflectance fields: biquadratic polynomials per view",
        "Meseth, Müller, Klein 2004",
        "analytic.rf_poly",
        image_light="Polynomials",
    ),
    _row(
        "rf_lobes",
        "Reflectance fields: cosine lobes per view",
        "Meseth, Müller, Klein 2004",
        "analytic.rf_lobes",
        image_light="Lobes",
    ),
    _row(
        "lafortune",
        "Generalized cosine lobes per texel",
        "Lafortune et al. 1997, McAllister et al. 2002",
        "analytic.lafortune",
        image_light="Lafortune",
    ),
    _row(
        "lafortune_lut",
        "Lafortune lobes times a table over views",
        "Daubert et al. 2001",
        "analytic.lafortune_lut",
        ports="lafortune",
        image_light="Lafortune",
    ),
    _row(
        "cmf",
        "Chained matrix factorization, clustered",
        "Suykens, vom Berge, Lagae, Dutré 2003",
        "factored.cmf",
    ),
    _row("hf", "Homomorphic factorization, clustered", "McCool, Ang, Ahmad 2001", "factored.hf", ports="cmf"),
    _row(
        "gbrdf",
        "g-BRDF: height field with editable microfacet materials",
        "Menzel, Guthe 2009",
        "gbrdf.definition",
        fit="gbrdf.decomposition.pipeline",
        editing="gbrdf.maps",
    ),
    _row(
        "neural",
        "Latent texture and a small network",
        "Rainer, Jakob, Ghosh, Weyrich 2019, Kuznetsov et al. 2021",
        "neural.definition",
        fit="neural.fit",
    ),
)


@cache
def methods() -> dict[str, Method]:
    """All methods by key, those of installed third-party packages included, where these can be loaded.

    Returns
    -------
    dict of str to Method
    """
    return _all_methods()[0]


@cache
def _all_methods() -> tuple[dict[str, Method], dict[str, BrokenPoint]]:
    """Methods by key, and entry points that give none."""
    rows = {row.key: row for row in _ROWS}
    usable, broken = usable_points(ENTRY_POINT_GROUP, Method)
    broken = dict(broken)
    packages = packages_of(ENTRY_POINT_GROUP)
    for name, row in usable.items():
        if row.key in rows:
            taken = f"the method '{row.key}' is there already"
            broken[name] = BrokenPoint(ENTRY_POINT_GROUP, name, packages[name], taken)
        else:
            rows[row.key] = row
    return rows, broken


def usable_methods() -> dict[str, Method]:
    """Methods by key, those of other packages only where their modules can be loaded too: what "all methods" means."""
    return {key: row for key, row in methods().items() if key not in _unloadable()}


@cache
def _unloadable() -> dict[str, str]:
    """Methods of other packages whose modules cannot be loaded, and why."""
    own = {row.key for row in _ROWS}
    found = {}
    for key, row in methods().items():
        if key not in own:
            try:
                _ = row.representation, row.fitting
            except Exception as error:  # whatever a foreign module lacks
                found[key] = one_line(error)
    return found


def representations() -> dict[str, type[Any]]:
    """Classes of representations by method, of those whose module can be loaded."""
    return {key: row.representation for key, row in usable_methods().items()}


def broken_points() -> list[BrokenPoint]:
    """Entry points of installed packages, of all groups, that cannot be used."""
    groups = [group for group in GROUPS if group != ENTRY_POINT_GROUP]
    others = [one for group in groups for one in usable_points(group)[1].values()]
    packages = packages_of(ENTRY_POINT_GROUP)
    modules = [
        BrokenPoint(ENTRY_POINT_GROUP, key, packages.get(key, "unknown"), reason)
        for key, reason in _unloadable().items()
    ]
    return [*_all_methods()[1].values(), *modules, *others]


def method(key: str, *, file: PathLike | None = None) -> Method:
    """The method ``key``.

    Raises
    ------
    InputError
        When there is none.
    """
    rows, broken = methods(), _all_methods()[1]
    if key not in rows and key in broken:
        raise InputError(f"a method of another package: {broken[key]}", file=file, field="method")
    if key not in rows:
        raise InputError("unknown method", file=file, got=repr(key), expected=f"one of {', '.join(rows)}")
    return rows[key]


def image_light(key: str, *, file: PathLike | None = None) -> type[Any]:
    """The class of a method's prefiltered path for environments.

    Raises
    ------
    InputError
        When the method has none.
    """
    row = method(key, file=file)
    if not row.image_light:
        having = ", ".join(name for name, other in methods().items() if other.image_light)
        raise InputError(
            "environments (constant, envmap) need a prefiltered path, which the method lacks",
            file=file,
            field="method",
            got=key,
            expected=f"one of {having}",
        )
    return imported(row.image_light)
