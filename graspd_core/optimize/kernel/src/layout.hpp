// Input of the kernel: plain arrays of float and int32 that the caller owns. graspd_core/optimize/kernel/builds.py
// mirrors these structs field by field, and compares their sizes by `graspd_sizes`.
//
// Lengths are in metres, angles in radians. Poses are rows of a 3x4 matrix. "SoA" arrays hold all x, then all y, then
// all z, each padded to a whole number of vectors.
#pragma once
#include <cstdint>

namespace graspd {

enum JointKind : int32_t { FIXED = 0, REVOLUTE = 1, PRISMATIC = 2 };

// The links of a hand, parents first. Link 0 is the base.
// T_parent_link = constant + sin(v) sine + cos(v) cosine + v slide, with v = multiplier q + shift.
struct Hand {
    int32_t links, joints, groups;
    const int32_t *parent, *joint, *kind;
    const float *constant, *sine, *cosine, *slide;  // links x 12
    const float* axis;                              // links x 3, in the link's frame
    const float *multiplier, *shift;                // links
    const float *lower, *upper, *joint_scale;       // joints
    const float* pivot;                             // 3, base frame: x[0:3] is the position of this point
    const float* reach;                             // groups
};

// Points fixed to links, sorted by group and then by link. A run is a stretch of points on one link.
struct Points {
    int32_t count, stride, runs;  // stride: length of each of the three rows of xyz
    const float* xyz;             // SoA, link frames
    const int32_t *run_start, *run_link;
    const int32_t* group_start;  // groups + 1. Null if groups do not matter
};

// Signed distance and unit normal at the nodes of a grid. The four channels of a node lie together.
struct Grid {
    const float* field;  // x y z 4
    int32_t nx, ny, nz;
    float origin[3], spacing;
};

// Boxes and round solids of the hand: `CollisionTensors` of hands/link_distance.py.
struct Solids {
    int32_t count;
    const float* pose;  // count x 12: T_link_solid
    const float *core, *radius;
    const int32_t *round, *link, *group;  // group: -1 without contact candidates
    // count x stride: squared distance at which bounding spheres of two solids meet. Zero for solids of adjacent links.
    const float* near;
    int32_t stride;
};

struct Spheres {
    Points centers;
    const float* radius;  // stride
    const float* weight;  // count x stride: 1 / 2R of checked pairs, zero for other pairs
};

struct Object {
    Grid grid;
    const float* confidence;  // x y z. Null if no surface is guessed
    float center[3], length;
    const float* features;  // SoA
    int32_t feature_count, feature_stride, coarse_features;
};

// The support as a half-space, the obstacles as grids, and the spheres of the hand that keep clear of both: first
// spheres at the corners of the hand's solids, then its collision spheres.
struct Obstacles {
    int32_t grids, has_support;
    const Grid* grid;
    float normal[3], offset, margin;
    Points corners, spheres;
    const float *corner_radius, *sphere_radius;  // stride
};

struct Weights {
    float wrench_resistance, distance, penetration, self_collision, posture, obstacle;
};

struct Problem {
    Hand hand;
    Points coarse, fine;
    Solids solids;
    Spheres spheres;
    Object object;
    Obstacles obstacles;
    int32_t directions, task_points, feature_pairs;
    const float* direction;  // directions x 6
    float friction, sharp_reach;
};

// Settings of the optimiser's steps (optimize/closed_form/closed_form_config.py).
struct Schedule {
    Weights weights, polish_weights;
    float delta_start, delta_end, radius_start;
    float translation_rate, rotation_rate, joint_rate;
    int32_t explore_steps, refine_steps, polish_steps, fine_steps, soft;
};

// Settings of the search for a pregrasp (config/planning_config.py), and of `settle`.
struct Pregrasp {
    float clearance, joint_rate, base_rate, joint_cost, base_cost, self_collision, keep;
    int32_t steps, spheres;  // spheres: 1 if the collision spheres must not overlap
};

// State with a row per start. x and best_x have 7 + joints columns: pivot position, quaternion wxyz, joints.
struct State {
    float *x, *mean, *square, *radius, *best_x, *best_loss, *loss;
};

// A mesh as a tree of boxes, in doubles (surface_tree.hpp).
struct Surface {
    const void *nodes, *triangles;
};

// The solids of a hand in doubles, sorted by link: boxes and round solids as in `Solids`, and the planes of hulls.
struct Bodies {
    int32_t count, links;
    const double *pose, *ball;  // count x 12: T_link_solid. count x 4: bounding sphere, solid frame
    const double *core, *radius;
    const int32_t *round, *link, *plane_start;  // plane_start: count + 1
    const double* planes;                       // outward unit normals and offsets, solid frame
};

constexpr int TERMS = 6;

}  // namespace graspd
