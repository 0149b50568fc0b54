"""For test suites of other renderers: whether a picture is what the reference shows.

In a test::

    from btfref.testing import assert_matches_reference

    def test_sphere():
        image = my_renderer("checker.lpca.exr", ...)  # (H, W, 3) linear radiance, or a path of an EXR or PNG
        assert_matches_reference(image, "sphere", btf="checker.lpca.exr", lights="points2")

References are rendered once and kept, see `btfref.validate.cache.folder`. Installing btfref gives pytest the fixture
``matches_reference``, the same function with the option ``--btfref-report FOLDER``, which writes a page for every
picture that fails.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from btfref.comparison import Comparison
    from btfref.types import PathLike


__all__ = ["assert_matches_reference"]


def assert_matches_reference(
    image: PathLike | np.ndarray,
    scene: PathLike,
    *,
    btf: PathLike | None = None,
    size: tuple[int, int] | None = None,
    grid: int = 4,
    shadows: bool | None = None,
    gates: str | Sequence[str] | None = None,
    cache: PathLike | None = None,
    report: PathLike | None = None,
    **parameters: object,
) -> Comparison:
    """Fail unless a picture passes the gates against the reference of a scene.

    Parameters
    ----------
    image : path-like or (H, W, 3) array
        Linear Rec. 709 radiance; ``.exr`` as it is, ``.png`` decoded from sRGB and judged as 8 bits.
    scene : path-like
        A Mitsuba scene file, or a shipped scene: plane, sphere, cloth.
    btf : path-like, optional
        The representation that the scene's parameter ``btf`` names.
    size : (int, int), optional
        Width and height in place of the scene's; by default the picture's own.
    grid : int
        n of the n × n sub-pixel samples, at (i + ½)/n, box filter: what the renderer under test should do.
    shadows : bool, optional
        Whether the renderer casts shadows; by default as the picture's file says, and no where it says nothing.
    gates : str or sequence of str, optional
        Keys of ``tolerances.toml`` in place of the usual ones.
    cache : path-like, optional
    report : path-like, optional
        Page to write when a gate fails.
    **parameters : str
        Further parameters of the scene, such as ``lights="points2"``.

    Returns
    -------
    btfref.comparison.Comparison

    Raises
    ------
    AssertionError
        With a line for every gate that failed.
    InputError
        For a picture or a scene that cannot be read.
    """
    import numpy as np

    from btfref.images import load_image
    from btfref.rendering.picture import read_picture_facts
    from btfref.validate.own_renderer import judge_image, reference_of

    __tracebackhide__ = True
    if size is None:
        shape = (np.asarray(image) if isinstance(image, np.ndarray) else load_image(image)).shape
        size = (int(shape[1]), int(shape[0]))
    if shadows is None:
        facts = None if isinstance(image, np.ndarray) else read_picture_facts(image)
        shadows = bool((facts or {}).get("shadows"))
    values = {key: str(value) for key, value in parameters.items()}
    if btf is not None:
        values["btf"] = str(btf)
    expected = reference_of(scene, parameters=values, size=size, grid=grid, shadows=shadows, cache=cache)
    comparison = judge_image(image, expected, gates=gates, flip=report is not None)
    failed = [gate.line for gate in comparison.gates if not gate.passed]
    if failed and report is not None:
        from btfref.report import Cell, write_report

        assert comparison.test is not None
        pictures = {"reference": expected.image, "test": comparison.test.astype(np.float32)}
        cell = Cell(f"{Path(str(scene)).stem}", pictures, comparison, f"parameters: {values}")
        write_report(report, title="Does not match its reference", cells=[cell], facts={"parameters": values})
        failed.append(f"report: {report}")
    if failed:
        raise AssertionError("the picture does not match its reference\n" + "\n".join(failed))
    return comparison
