"""What `btfref.validate.run` computes of a method beside its pictures: fits and checks."""
