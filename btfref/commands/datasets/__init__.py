"""The commands of standard data sets and of the board of methods on them."""
