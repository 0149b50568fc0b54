"""The board: how far off methods are on a standard data set, as a static page, from files that anybody can hand in.

`rows` reads what was handed in, `scoring` judges its answers, `ranking` orders methods, `site` writes the page;
`baselines` makes the rows of the suite's own methods.
"""
