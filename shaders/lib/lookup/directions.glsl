// Provides view_stencil and light_stencil: neighbours of a direction among the measured ones; directions_valid.
// Expects the samplers view_rings or view_triangles and view_cells, the same for light_, and light_directions; view_slots, light_slots.
// With DRAWN_VIEWS the view's is one neighbour, drawn by view_draw, a number in [0, 1) that the host sets before it asks.

#include "lib/lookup/draws.glsl"
#include "lib/lookup/rings.glsl"
#include "lib/lookup/triangles.glsl"

#ifdef DRAWN_VIEWS
float view_draw = 0.0;
#endif

#ifdef VIEW_RINGS_DIM0
uniform sampler2DArray view_rings;
#else
uniform sampler2DArray view_triangles;
uniform sampler2DArray view_cells;
#endif

#ifdef VIEW_SLOTS_DIM0
uniform usampler2DArray view_slots;  // place of each view in the maps, of which only some are kept
#endif

#ifdef LIGHT_RINGS_DIM0
uniform sampler2DArray light_rings;
uniform sampler2DArray light_directions;
#else
uniform sampler2DArray light_triangles;
uniform sampler2DArray light_cells;
#endif

#ifdef LIGHT_SLOTS_DIM0
uniform usampler2DArray light_slots;
#endif

// Above the horizon and neither NaN nor far from unit length (comparisons with NaN are false). The least z is the
// smallest normal float: where subnormal ones are flushed to 0 the answer is the same.
bool direction_valid(vec3 w) {
    float square = dot(w, w);
    return w.z >= 1.17549435e-38 && square > 0.25 && square < 4.0;
}

bool directions_valid(vec3 w_light, vec3 w_view) {
    return direction_valid(w_light) && direction_valid(w_view);
}

#if defined(VIEW_SLOTS_DIM0) || defined(LIGHT_SLOTS_DIM0)
Stencil kept_samples(usampler2DArray slots, Stencil s) {
    for (int i = 0; i < 4; ++i) {
        uint slot = table_fetch(slots, s.index[i]).r;
        // 0xffffffff: not kept. A weight that is no number shows in the picture, and is counted there.
        bool absent = slot == 0xffffffffu;
        s.index[i] = absent ? 0 : int(slot);
        s.weight[i] = absent && s.weight[i] > 0.0 ? uintBitsToFloat(0x7fc00000u) : s.weight[i];
    }
    return s;
}
#endif

Stencil view_neighbours(vec3 w) {
#ifdef VIEW_RINGS_DIM0
    return ring_stencil(view_rings, VIEW_RINGS_DIM0, w);
#else
    return triangle_stencil(view_triangles, VIEW_TRIANGLES_DIM0, view_cells, VIEW_CELLS_DIM0, w, false);
#endif
}

Stencil view_stencil(vec3 w) {
    Stencil s = view_neighbours(w);
#if defined(DRAWN_VIEWS) && !defined(NEAREST_VIEW)
    s = drawn(s, view_draw);
#endif
#ifdef VIEW_SLOTS_DIM0
    s = kept_samples(view_slots, s);
#endif
    return s;
}

// Below the outermost samples the weights sum to cos(theta)/cos(theta_last), so that B falls to zero at the horizon.
Stencil light_stencil(vec3 w) {
#ifdef LIGHT_RINGS_DIM0
    Stencil s = ring_stencil(light_rings, LIGHT_RINGS_DIM0, w);
    float cos_last = table_fetch(light_directions, LIGHT_DIRECTIONS_DIM0 - 1).z;
    s.weight *= ring_fade(light_rings, LIGHT_RINGS_DIM0, w, cos_last);
#else
    Stencil s = triangle_stencil(light_triangles, LIGHT_TRIANGLES_DIM0, light_cells, LIGHT_CELLS_DIM0, w, true);
#endif
#ifdef LIGHT_SLOTS_DIM0
    s = kept_samples(light_slots, s);
#endif
    return s;
}
