// Penetration of support and obstacles by the hand (optimize/obstacle_distance.py).
#pragma once
#include "terms.hpp"

namespace graspd {

// Returns the loss of the spheres at the corners of the hand's solids in the support, and adds forces to the links.
static float support_depth(const Problem& p, float weight, Scratch& s) {
    const Obstacles& o = p.obstacles;
    Samples& at = s.obstacle;
    float total = 0;
    for (int i = 0; i < o.corners.count; i++) {
        float gap = at.x[i] * o.normal[0] + at.y[i] * o.normal[1] + at.z[i] * o.normal[2] - o.offset - o.corner_radius[i];
        float slope;
        total += tempered(o.margin - gap, &slope);
        at.gx[i] = -weight * slope * o.normal[0];
        at.gy[i] = -weight * slope * o.normal[1];
        at.gz[i] = -weight * slope * o.normal[2];
    }
    if (total != 0) gather_wrenches(o.corners, at, s.wrench);
    return total;
}

// Returns whether any sphere is nearer than `margin` to the grid. In a bin, most obstacles are away from the hand.
static bool near_grid(const Grid& grid, int count, const float* radius, float margin, const Samples& at) {
    const int nodes[3] = {grid.nx, grid.ny, grid.nz};
    float half[3], middle[3];
    for (int k = 0; k < 3; k++) {
        half[k] = 0.5f * (nodes[k] - 1) * grid.spacing;
        middle[k] = grid.origin[k] + half[k];
    }
    int away = 0;
    for (int i = 0; i < count; i++) {
        float reach = radius[i] + margin;
        away += (fabsf(at.x[i] - middle[0]) - half[0] >= reach) | (fabsf(at.y[i] - middle[1]) - half[1] >= reach) |
                (fabsf(at.z[i] - middle[2]) - half[2] >= reach);
    }
    return away < count;
}

// Returns the loss of the spheres at placed points in one obstacle, and adds forces to the links.
static float neighbour_depth(
    const Grid& grid, const Points& points, const float* radius, float margin, float weight, Scratch& s) {
    Samples& at = s.obstacle;
    if (!near_grid(grid, points.count, radius, margin, at)) return 0;
    sample(grid, points.count, at);
    float total = 0;
    for (int i = 0; i < points.count; i++) {
        float slope;
        total += tempered(margin - (at.phi[i] - radius[i]), &slope);
        at.a_phi[i] = -weight * slope;
        at.a_nx[i] = at.a_ny[i] = at.a_nz[i] = 0;
    }
    if (total != 0) {
        sample_adjoint(grid, points.count, at);
        gather_wrenches(points, at, s.wrench);
    }
    return total;
}

// Returns the least distance of the spheres at placed points to one obstacle [m], at most `wide`.
static float neighbour_gap(const Grid& grid, const Points& points, const float* radius, float wide, Samples& at) {
    if (!near_grid(grid, points.count, radius, wide, at)) return wide;
    sample(grid, points.count, at);
    for (int i = 0; i < points.count; i++) wide = std::min(wide, at.phi[i] - radius[i]);
    return wide;
}

// Returns the least distance of the hand to support and obstacles [m], at most `wide`. `s.link` has the links' poses.
static float least_gap(const Problem& p, float wide, Scratch& s) {
    const Obstacles& o = p.obstacles;
    Samples& at = s.obstacle;
    place_points(o.corners, s.link, at.x, at.y, at.z);
    for (int i = 0; i < o.corners.count && o.has_support; i++)
        wide = std::min(wide, at.x[i] * o.normal[0] + at.y[i] * o.normal[1] + at.z[i] * o.normal[2] - o.offset -
                                  o.corner_radius[i]);
    for (int k = 0; k < o.grids; k++) wide = neighbour_gap(o.grid[k], o.corners, o.corner_radius, wide, at);
    if (o.grids == 0) return wide;
    place_points(o.spheres, s.link, at.x, at.y, at.z);
    for (int k = 0; k < o.grids; k++) wide = neighbour_gap(o.grid[k], o.spheres, o.sphere_radius, wide, at);
    return wide;
}

// Returns the unweighted loss, and adds the weighted forces to the links.
static float obstacle_depth(const Problem& p, float weight, Scratch& s) {
    const Obstacles& o = p.obstacles;
    if (!o.has_support && o.grids == 0) return 0;
    Samples& at = s.obstacle;
    float total = 0;
    place_points(o.corners, s.link, at.x, at.y, at.z);
    if (o.has_support) total += support_depth(p, weight, s);
    for (int k = 0; k < o.grids; k++) total += neighbour_depth(o.grid[k], o.corners, o.corner_radius, o.margin, weight, s);
    if (o.grids == 0) return total;
    place_points(o.spheres, s.link, at.x, at.y, at.z);
    for (int k = 0; k < o.grids; k++) total += neighbour_depth(o.grid[k], o.spheres, o.sphere_radius, o.margin, weight, s);
    return total;
}

}  // namespace graspd
