"""Pure functions shared by all methods: directions, quadrature, maps, low-rank algebra."""
