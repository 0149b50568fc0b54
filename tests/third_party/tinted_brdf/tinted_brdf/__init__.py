"""One apparent BRDF, tinted by every texel: a method for btfref from outside."""

from btfref.registry import Method

METHOD = Method(
    key="tinted_brdf",
    title="One apparent BRDF, tinted by every texel",
    paper="a worked example",
    module="tinted_brdf.fit",
    plugin="tinted_brdf.plugin",
    shader="tinted_brdf.glsl",
    shader_package="tinted_brdf",
)
