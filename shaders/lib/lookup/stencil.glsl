// Provides Stencil: up to four samples of a table and the weights that blend them.
// Expects nothing.

struct Stencil {
    ivec4 index;
    vec4 weight;  // non-negative; a weight of zero means that the sample need not be fetched
};
