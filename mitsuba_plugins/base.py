"""The BSDF plugin ``btf``: sampling, flags, and the translation of Mitsuba's ``wi``/``wo``.

Nothing else in the project uses ``wi`` and ``wo``.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from btfref.conventions import FILTER_TYPES
from btfref.errors import InputError
from btfref.numerics.footprint import MODES
from btfref.numerics.interpolations import INTERPOLATIONS
from btfref.numerics.sphere.frames import uv_transform
from btfref.registry import method
from btfref.representations.protocol import DrawsViews
from mitsuba_plugins.lib.draws import of_lookups, refuse_gradients
from mitsuba_plugins.lib.footprint import LevelOfDetail
from mitsuba_plugins.lib.frame import hand_of
from mitsuba_plugins.lib.guide import LightGuide
from mitsuba_plugins.lib.lookup import valid_directions
from mitsuba_plugins.lib.maps import Maps
from mitsuba_plugins.lib.parameters import refuse_unknown
from mitsuba_plugins.lib.proposals import Guided, Mixture
from mitsuba_plugins.protocol import Displaced, HoldsFixed, LevelledEvaluator, Proposes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from btfref.representations.protocol import Representation
    from btfref.types import JitArray
    from mitsuba_plugins.protocol import Proposal


__all__ = ["Maps", "make_bsdf"]


def make_bsdf() -> type:
    """The plugin class for the current Mitsuba variant."""

    class BTF(mi.BSDF):
        """A compressed BTF.

        ============= ========= ===================================================================================
        parameter     type      meaning
        ============= ========= ===================================================================================
        filename      string    the representation, as written by ``btfref fit``
        filter_type   string    "bilinear" or "nearest"; default: what the file says
        interpolation string    "blended" (default), all measured views around the view; "drawn", one of them in each
                                lookup, and its table of light directions: cheaper, the same on average, with more noise
        scale         float     factor of the reflectance, ≥ 0; default 1
        to_uv         transform of the texture coordinates; its rotation, or reflection, is that of the local frame too
        sampling      string    what proposes light directions: "data", tables of the data; "lobes", the method's own
                                lobes or microfacets; "both", half of each; "cosine", for comparison. Default: what has
                                the least variance for its time, "data" for a method without lobes
        views         string    indices of the measured views to keep, such as "0 3 17"; default: all. A lookup that
                                needs another one gives no number
        lights        string    likewise of the lights
        entries       string    likewise of the entries that texels name: clusters, materials
        levels        string    likewise of the levels of detail
        lod           string    level of detail: "auto" (default), by the pixel's footprint; "distance", log2 of it;
                                "none"
        lod_bias      float     added to the level of detail, so that "none" with a bias is a fixed level; default 0
        lod_unit      float     distance whose level of detail is 0 in mode "distance", > 0; default 1
        pixel_angle   float     that a pixel subtends in radians, for "auto"; default 0: not known, finest level
        camera        point     from where distances count; default: the origin of each ray
        ============= ========= ===================================================================================

        ``mi.traverse`` offers ``scale`` and the maps that can be differentiated, in float32 whatever their type in the
        file; :func:`mitsuba_plugins.representation_of` makes a representation of them again. Integer maps and codes of
        8 bits are not offered.

        Values hold the light's cosine already. The surface reflects on its front side only; wrap it in
        ``twosided`` for both. Methods without levels of detail ignore the parameters that choose one.
        """

        def __init__(self, props: JitArray) -> None:
            mi.BSDF.__init__(self, props)
            from btfref.representations import load

            refuse_unknown(props.keys())
            self.filename = _parameter(props, "filename", None)
            if self.filename is None:
                raise InputError("the plugin 'btf' needs a file", field="filename")
            path = str(mi.file_resolver().resolve(str(self.filename)))
            kept = {name: _indices(props, name) for name in ("views", "lights", "entries", "levels")}
            self._read = partial(load, path, **kept)
            representation = self._read()
            own = representation.meta["filter_type"]
            self.filter_type = _choice(props, "filter_type", own, FILTER_TYPES)
            self.scale = mi.Float(_number(props, "scale", 1.0, least=0.0))
            affine, self.turn = uv_transform(_matrix(_parameter(props, "to_uv", None)))
            # Python floats: NumPy scalars would try to read a symbolic operand.
            self.affine = affine.tolist()
            self.draws = _choice(props, "interpolation", INTERPOLATIONS[0], INTERPOLATIONS) == "drawn"
            self.draws_views = isinstance(representation, DrawsViews)
            self.key = representation.meta["method"]
            self.maps = Maps(representation, self.filter_type)
            self.evaluator = method(self.key).evaluator(self.maps)
            self.detail = self._level_of_detail(props)
            self.own_share = self._share_of_own_lobes(props)
            if self.own_share < 1:
                guided = "cosine" if self.own_share < 0 else "data"
                self.guide = LightGuide(representation, self.maps.views, guided)
            flags = (
                mi.BSDFFlags.GlossyReflection
                | mi.BSDFFlags.FrontSide
                | mi.BSDFFlags.SpatiallyVarying
                | mi.BSDFFlags.Anisotropic
                | mi.BSDFFlags.NonSymmetric
            )
            self.m_components = [flags]
            self.m_flags = flags

        def _share_of_own_lobes(self, props: JitArray) -> float:
            """Share of the method's own proposal in [0, 1], beside the guide; −1: neither."""
            shares, default = {"data": 0.0, "cosine": -1.0}, "data"
            if isinstance(self.evaluator, Proposes):
                shares |= {"lobes": 1.0, "both": 0.5}
                default = self.evaluator.sampling
            return shares[_choice(props, "sampling", default, tuple(shares))]

        def _level_of_detail(self, props: JitArray) -> LevelOfDetail | None:
            """What chooses λ, or None for a method without levels; parameters are checked either way."""
            mode = _choice(props, "lod", "auto", MODES)
            bias = _number(props, "lod_bias", 0.0)
            unit = _number(props, "lod_unit", 1.0, positive=True)
            angle = _number(props, "pixel_angle", 0.0, least=0.0)
            camera = _parameter(props, "camera", None)
            if not isinstance(self.evaluator, LevelledEvaluator):
                return None
            return LevelOfDetail(mode, bias, unit, angle, camera, self.affine, self.maps.shape)

        def _uv(self, si: JitArray) -> JitArray:
            # Terms with factor 0 are left out: a coordinate that is not finite must not spoil the other one.
            def row(a: float, b: float, c: float) -> JitArray:
                value = mi.Float(c) if b == 0 else dr.fma(si.uv.y, b, c)
                return value if a == 0 else dr.fma(si.uv.x, a, value)

            return mi.Point2f(*(row(*coefficients) for coefficients in self.affine))

        def _local(self, si: JitArray, w: JitArray) -> tuple[JitArray, JitArray]:
            """A direction in the texture's frame, and whether it is valid; the pole stands in for invalid ones.

            Sanitized one by one, so that what depends on the view alone is recorded once for all methods that a
            kernel calls.
            """
            hand = hand_of(si) * self.turn.hand
            c, s = self.turn.cosine, self.turn.sine
            y = hand * w.y
            if (c, s) != (1.0, 0.0):
                w = mi.Vector3f(c * w.x - s * y, s * w.x + c * y, w.z)
            else:
                w = mi.Vector3f(w.x, y, w.z)
            valid = valid_directions(w)
            return dr.select(valid, w, mi.Vector3f(0, 0, 1)), valid

        def _mitsubas(self, si: JitArray, w: JitArray) -> JitArray:
            """A direction of the texture's frame in Mitsuba's."""
            c, s = self.turn.cosine, self.turn.sine
            return mi.Vector3f(c * w.x + s * w.y, hand_of(si) * self.turn.hand * (c * w.y - s * w.x), w.z)

        @staticmethod
        def _enabled(ctx: JitArray) -> bool:
            return ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)

        def _view(self, si: JitArray, w_view: JitArray, active: JitArray) -> tuple[dict[str, Any], Proposal]:
            """What is known of the view alone: arguments of the evaluator, and what proposes light directions.

            An evaluator with geometry finds the point that the view sees, and the guide looks its tables up there;
            others stay at ``uv``.
            """
            uv = self._uv(si)
            known = self._known(si, uv, w_view)
            # The same for both: a guide that knows nothing of the drawn view would cost variance.
            draw = of_lookups(uv, w_view) if self.draws else None
            place = uv
            if isinstance(self.evaluator, Displaced):
                hit, place = self.evaluator.hit(uv, w_view, active)
                known = known | {"hit": hit}
            if self.own_share > 0:
                own = self.evaluator.proposal(uv, w_view, active, **known)
                if self.own_share == 1:
                    return known, own
            guided = Guided(self.guide, self.guide.neighbours(place, w_view, known.get("lod"), draw))
            return known, guided if self.own_share <= 0 else Mixture(own, guided, self.own_share)

        def _known(self, si: JitArray, uv: JitArray, w_view: JitArray) -> dict[str, Any]:
            """Arguments of the evaluator that do not depend on the light."""
            known = {} if self.detail is None else self.detail(si)
            return known | ({"draw": of_lookups(uv, w_view)} if self.draws and self.draws_views else {})

        def _value(
            self,
            ctx: JitArray,
            si: JitArray,
            w_light: JitArray,
            w_view: JitArray,
            active: JitArray,
            known: dict[str, Any] | None = None,
        ) -> JitArray:
            if ctx.mode == mi.TransportMode.Importance:
                # The view's hit is of no use where the roles are swapped.
                w_view, w_light, known = w_light, w_view, None
            uv = self._uv(si)
            if known is None:
                known = self._known(si, uv, w_view)
            value = self.evaluator.evaluate(uv, w_light, w_view, active, **known)
            return dr.select(active, value * self.scale, 0)

        def _directions(
            self, si: JitArray, wo: JitArray, active: JitArray
        ) -> tuple[JitArray, JitArray, JitArray]:
            w_view, view_valid = self._local(si, si.wi)
            w_light, light_valid = self._local(si, wo)
            return w_view, w_light, mi.Bool(active) & view_valid & light_valid

        def eval(self, ctx: JitArray, si: JitArray, wo: JitArray, active: JitArray = True) -> JitArray:
            if not self._enabled(ctx):
                return mi.Color3f(0)
            w_view, w_light, active = self._directions(si, wo, active)
            return self._value(ctx, si, w_light, w_view, active)

        def pdf(self, ctx: JitArray, si: JitArray, wo: JitArray, active: JitArray = True) -> JitArray:
            if not self._enabled(ctx):
                return mi.Float(0)
            # The sampled direction always plays the light: a guide for importance transport is not worth its memory.
            w_view, w_light, active = self._directions(si, wo, active)
            return self._view(si, w_view, active)[1].pdf(w_light, active)

        def eval_pdf(
            self, ctx: JitArray, si: JitArray, wo: JitArray, active: JitArray = True
        ) -> tuple[JitArray, JitArray]:
            if not self._enabled(ctx):
                return mi.Color3f(0), mi.Float(0)
            w_view, w_light, active = self._directions(si, wo, active)
            known, proposal = self._view(si, w_view, active)
            value = self._value(ctx, si, w_light, w_view, active, known)
            return value, proposal.pdf(w_light, active)

        def sample(
            self, ctx: JitArray, si: JitArray, sample1: JitArray, sample2: JitArray, active: JitArray = True
        ) -> tuple[JitArray, JitArray]:
            bs = dr.zeros(mi.BSDFSample3f)
            if not self._enabled(ctx):
                return bs, mi.Color3f(0)
            w_view, view_valid = self._local(si, si.wi)
            active = mi.Bool(active) & view_valid
            known, proposal = self._view(si, w_view, active)
            bs.wo = self._mitsubas(si, proposal.sample(sample1, sample2))
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = 0
            w_light, light_valid = self._local(si, bs.wo)
            active &= light_valid
            value = self._value(ctx, si, w_light, w_view, active, known)
            bs.pdf = proposal.pdf(w_light, active)
            usable = active & (bs.pdf > 0)
            return bs, dr.select(usable, value / bs.pdf, 0)

        def traverse(self, callback: JitArray) -> None:
            callback.put("scale", self.scale, mi.ParamFlags.Differentiable)
            fixed = self.evaluator.fixed if isinstance(self.evaluator, HoldsFixed) else ()
            for name, values in self.maps.masters(fixed).items():
                callback.put(name, values, mi.ParamFlags.Differentiable)
            if self.detail is not None:
                self.detail.traverse(callback)

        def parameters_changed(self, keys: list[str]) -> None:
            # A moved camera changes no map.
            changed = self.maps.take_over(keys)
            if self.draws:
                refuse_gradients((self.scale, *self.maps.tensors.values()))
            if changed:
                self.evaluator.update(self.maps)

        def representation(self) -> Representation:
            """See :func:`mitsuba_plugins.representation_of`; the file is read anew, since no copy is kept."""
            return self.maps.put_into(self._read())

        def to_string(self) -> str:
            return (
                f"BTF[filename={self.filename}, method={self.key}, filter_type={self.filter_type}, "
                f"texels={self.maps.shape}, displaced={isinstance(self.evaluator, Displaced)}]"
            )

    return BTF


def _parameter(props: JitArray, name: str, default: object) -> Any:
    return props[name] if name in props else default


def _choice(props: JitArray, name: str, default: str, choices: Sequence[str]) -> str:
    value = _parameter(props, name, default)
    if value not in choices:
        raise InputError(
            "unknown value of a parameter", field=name, got=repr(value), expected=" or ".join(choices)
        )
    return value


def _indices(props: JitArray, name: str) -> list[int] | None:
    """Whole numbers of a parameter, separated by spaces or commas; None where there is none."""
    text = _parameter(props, name, None)
    if text is None:
        return None
    try:
        return [int(word) for word in str(text).replace(",", " ").split()]
    except ValueError:
        raise InputError("not a list of indices", field=name, got=repr(text)) from None


def _number(
    props: JitArray, name: str, default: float, *, least: float = -np.inf, positive: bool = False
) -> float:
    value = float(_parameter(props, name, default))
    if not (np.isfinite(value) and value >= least and (value > 0 or not positive)):
        bound = " > 0" if positive else "" if least == -np.inf else f" ≥ {least:g}"
        raise InputError(
            f"the {name} is out of range", field=name, got=value, expected=f"a finite value{bound}"
        )
    return value


def _matrix(transform: JitArray) -> np.ndarray:
    return np.eye(4) if transform is None else np.asarray(transform.matrix, float)
