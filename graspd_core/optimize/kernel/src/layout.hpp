// What the kernel reads: plain arrays of float and int32 that the caller owns. graspd_core/optimize/kernel/builds.py mirrors
// these structs field by field; `graspd_sizes` lets it check that it does.
//
// Lengths are metres, angles radians. Poses are rows of a 3x4 matrix. "SoA" arrays hold all x, then all y, then all z,
// each padded to a whole number of vectors.
#pragma once
#include <cstdint>

namespace graspd {

enum JointKind : int32_t { FIXED = 0, REVOLUTE = 1, PRISMATIC = 2 };

// Links in an order in which parents come first; link 0 is the base.
// T_parent_link = constant + sin(v) sine + cos(v) cosine + v slide, with v = multiplier q + shift.
struct Hand {
    int32_t links, joints, groups;
    const int32_t *parent, *joint, *kind;
    const float *constant, *sine, *cosine, *slide;  // links x 12
    const float* axis;                              // links x 3, in the link's frame
    const float *multiplier, *shift;                // links
    const float *lower, *upper, *joint_scale;       // joints
    const float* pivot;                             // 3, base frame: what x[0:3] is the place of
    const float* reach;                             // groups
};

// Points fixed to links, sorted by group and then link: `runs` stretches of equal link.
struct Points {
    int32_t count, stride, runs;  // stride: length of each of the three rows of xyz
    const float* xyz;             // SoA, link frames
    const int32_t *run_start, *run_link;
    const int32_t* group_start;  // groups + 1; null where groups do not matter
};

// Signed distance and unit normal at nodes, the four channels of a node together.
struct Grid {
    const float* field;  // x y z 4
    int32_t nx, ny, nz;
    float origin[3], spacing;
};

// Boxes and round solids of the hand, as in hands/self_collision.py.
struct Solids {
    int32_t count;
    const float* pose;  // count x 12: T_link_solid
    const float *core, *radius;
    const int32_t *round, *link, *group;  // group: -1 where it has no contact candidate
    // count x stride: the squared distance at which balls about two solids meet; zero for links that are adjacent.
    const float* near;
    int32_t stride;
};

struct Spheres {
    Points centers;
    const float* radius;  // stride
    const float* weight;  // count x stride: 1 / 2R of checked pairs, zero elsewhere
};

struct Object {
    Grid grid;
    const float* confidence;  // x y z, null where all of the surface is known
    float center[3], length;
    const float* features;  // SoA
    int32_t feature_count, feature_stride, coarse_features;
};

// The support's half-space and the neighbours' grids, and the hand's points that keep clear of them: balls about the
// corners of its solids first, then its proxy spheres.
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

// How the search steps (optimize/closed_form/closed_form_config.py).
struct Schedule {
    Weights weights, polish_weights;
    float delta_start, delta_end, radius_start;
    float translation_rate, rotation_rate, joint_rate;
    int32_t explore_steps, refine_steps, polish_steps, fine_steps, soft;
};

// How a pregrasp is sought (config/planning_config.py).
struct Pregrasp {
    float clearance, joint_rate, base_rate, joint_cost, base_cost, self_collision, keep;
    int32_t steps, spheres;  // spheres: whether they are kept out of each other too
};

// Rows of one matrix each: `variables` is 7 + joints (place of the pivot, quaternion wxyz, joints).
struct State {
    float *x, *mean, *square, *radius, *best_x, *best_loss, *loss;
};

// A mesh as a tree of boxes (surface_tree.hpp), in doubles.
struct Surface {
    const void *nodes, *triangles;
};

// The solids of a hand in doubles, sorted by link: boxes and round ones as in `Solids`, and the planes of hulls.
struct Bodies {
    int32_t count, links;
    const double *pose, *ball;  // count x 12: T_link_solid; count x 4: its bounding ball, in the solid's frame
    const double *core, *radius;
    const int32_t *round, *link, *plane_start;  // plane_start: count + 1
    const double* planes;                       // outward unit normals and offsets, in the solid's frame
};

constexpr int TERMS = 6;

}  // namespace graspd
