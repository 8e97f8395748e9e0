// Closed-form loss of one pose, and its gradient (docs/method.md, `evaluate` of optimize/problem.py).
#pragma once
#include "obstacles.hpp"
#include "sharp_points.hpp"
#include "wrench_resistance.hpp"

namespace graspd {

// Settings of one evaluation: padding and contact width [m], all candidates or the coarse ones, all sharp points with a
// short reach, and contact that decays over its width.
struct Look {
    float radius, delta;
    bool fine, sharp, soft;
};

// Returns the weighted loss at x. Writes `gradient` (7 + joints) and s.terms (unweighted, in the order of `Weights`).
static float evaluate(const Problem& p, const Weights& w, const float* x, Look look, float* gradient, Scratch& s) {
    const Hand& hand = p.hand;
    const Points& points = look.fine ? p.fine : p.coarse;
    Samples& at = s.candidates;
    float base[12];
    base_pose(hand, x, base);
    place_links(hand, base, x + 7, s.link);
    place_points(points, s.link, at.x, at.y, at.z);
    sample(p.object.grid, points.count, at);
    for (int i = 0; i < 6 * hand.links; i++) s.wrench[i] = 0;

    float sunk = candidate_penetration(points.count, look.radius, w.penetration, at, s.key);
    find_gaps(hand, points, look.radius, s);
    int features = look.sharp ? p.object.feature_count : p.object.coarse_features;
    int pairs = sharp_points(p, features, w.penetration, &sunk, s);
    float distance = touch(hand, look.sharp ? p.sharp_reach : 0.f, w.distance, s);
    float resistance = wrench_resistance(p, points, look.radius, look.delta, look.soft, w.wrench_resistance, s);

    sample_adjoint(p.object.grid, points.count, at);
    for (int j = 0; j < s.task.count; j++) {
        int i = s.task.index[j];
        at.gx[i] += s.task.gax[j];
        at.gy[i] += s.task.gay[j];
        at.gz[i] += s.task.gaz[j];
    }
    gather_wrenches(points, at, s.wrench);
    push_pairs(p, pairs, s);
    float collision = self_collision(p.spheres, w.self_collision, s.link, s.sphere, s.wrench);
    float blocked = obstacle_depth(p, w.obstacle, s);
    float bent = posture(hand, w.posture, x + 7, gradient + 7);
    pull_back_joints(hand, s.link, s.wrench, gradient + 7);
    pull_back_base(x, s.wrench, gradient);

    float terms[TERMS] = {resistance, distance, sunk, collision, bent, blocked};
    memcpy(s.terms, terms, sizeof terms);
    return w.wrench_resistance * resistance + w.distance * distance + w.penetration * sunk +
           w.self_collision * collision + w.posture * bent + w.obstacle * blocked;
}

// Returns the least distance of the coarse candidates to the object [m].
static float least_distance(const Problem& p, const float* x, Scratch& s) {
    float base[12], nearest = INFINITY;
    base_pose(p.hand, x, base);
    place_links(p.hand, base, x + 7, s.link);
    place_points(p.coarse, s.link, s.candidates.x, s.candidates.y, s.candidates.z);
    sample(p.object.grid, p.coarse.count, s.candidates);
    for (int i = 0; i < p.coarse.count; i++) nearest = s.candidates.phi[i] < nearest ? s.candidates.phi[i] : nearest;
    return nearest;
}

}  // namespace graspd
