"""The whole matrix: every method, under every light, in every scene, of every mesostructure, and who is to blame.

`btfref.validate.run.validate` computes it, `btfref.validate.self_test.self_test` shows that its gates can fail,
`btfref.report.validation.write_validation` writes the report.
"""
