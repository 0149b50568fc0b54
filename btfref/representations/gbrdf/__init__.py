"""g-BRDF: a height field with a few microfacet materials, made for editing."""
