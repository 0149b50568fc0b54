"""A witness that shares no reading with the renderers: what both get wrong alike, agreement cannot show.

`scene` says a scene in numbers, `caster` draws it from those by ray casting, `gates` compares both renderers with it.
"""
