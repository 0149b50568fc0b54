"""Decomposition of a sampled BTF into a g-BRDF (Menzel and Guthe 2009, section 5), a module a stage.

``pairs`` reciprocal images · ``heights`` similarity and minimum cut · ``normals`` Helmholtz normals and their fusion
with heights · ``reflectance`` alternating least squares · ``materials`` clustering · ``pipeline`` all of them in order.
"""
