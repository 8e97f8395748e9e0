// The C interface. Functions return 0, or 1 if there is too little memory. They never throw, and write only to outputs.
#include "hand_overlap.hpp"
#include "stages.hpp"
#include "threads.hpp"
#include "wrench_hull.hpp"

using namespace graspd;

namespace {
template <class Body>
int32_t guarded(Body body) {
    try {
        body();
        return 0;
    } catch (const std::exception&) {
        return 1;
    }
}
}  // namespace

extern "C" {

// Writes the sizes of all structures, for the caller to compare with its own structures. Returns their number.
int32_t graspd_sizes(int32_t* sizes) {
    int32_t known[] = {sizeof(Hand),      sizeof(Points),  sizeof(Grid),    sizeof(Solids),   sizeof(Spheres), sizeof(Object),
                       sizeof(Obstacles), sizeof(Weights), sizeof(Problem), sizeof(Schedule), sizeof(State),
                       sizeof(Pregrasp),  sizeof(Surface), sizeof(Bodies)};
    memcpy(sizes, known, sizeof known);
    return sizeof known / sizeof known[0];
}

int32_t graspd_lanes() { return LANES; }

// Computes loss, gradient (rows x variables) and unweighted terms (rows x 6) of every row of x (rows x variables).
int32_t graspd_evaluate(const Problem* p, const Weights* weights, int32_t rows, const float* x, const float* radius,
                        float delta, int32_t fine, int32_t sharp, int32_t soft, float* loss, float* gradient, float* terms,
                        int32_t threads) {
    return guarded([&] {
        const int variables = 7 + p->hand.joints;
        for_rows(*p, rows, threads, [&](int row, Scratch& s, bool) {
            Look look = {radius[row], delta, fine != 0, sharp != 0, soft != 0};
            loss[row] = evaluate(*p, *weights, x + row * variables, look, gradient + row * variables, s);
            memcpy(terms + TERMS * row, s.terms, sizeof s.terms);
        });
    });
}

// Computes for every row of x the least distance of the coarse candidates to the object [m].
int32_t graspd_least_distance(const Problem* p, int32_t rows, const float* x, float* distance, int32_t threads) {
    return guarded([&] {
        const int variables = 7 + p->hand.joints;
        for_rows(*p, rows, threads,
                 [&](int row, Scratch& s, bool) { distance[row] = least_distance(*p, x + row * variables, s); });
    });
}

// Runs the steps [from, to) of every row. Every few milliseconds `poll` gets the number of steps done. True stops all.
int32_t graspd_run_steps(const Problem* p, const Schedule* schedule, const State* state, int32_t rows, int32_t from,
                         int32_t to, int32_t threads, Stop::Poll poll) {
    return guarded([&] {
        Stop stop(poll);
        for_rows(*p, rows, threads, [&](int row, Scratch& s, bool caller) {
            Array<float> gradient(7 + p->hand.joints);
            run_steps(*p, *schedule, *state, row, from, to, gradient, s, [&] { return stop.go(caller); });
        });
    });
}

// Finds pregrasps `out` (rows x (3 + joints)) of grasps x (rows x variables, with base positions), by `find_pregrasp`.
int32_t graspd_find_pregrasps(const Problem* p, const Pregrasp* settings, int32_t rows, const float* x, float* out,
                              float* share, int32_t threads, Stop::Poll poll) {
    return guarded([&] {
        Stop stop(poll);
        for_rows(*p, rows, threads, [&](int row, Scratch& s, bool caller) {
            const float* grasp = x + row * (7 + p->hand.joints);
            share[row] = find_pregrasp(
                *p, *settings, grasp, out + row * (3 + p->hand.joints), s, [&] { return stop.go(caller); });
        });
    });
}

// Writes to `out` (rows x (3 + joints)) grasps near those in x (with base positions) that penetrate the object less.
int32_t graspd_settle(const Problem* p, const Pregrasp* settings, int32_t rows, const float* x, float* out,
                      int32_t threads, Stop::Poll poll) {
    return guarded([&] {
        Stop stop(poll);
        for_rows(*p, rows, threads, [&](int row, Scratch& s, bool caller) {
            settle(*p, *settings, x + row * (7 + p->hand.joints), out + row * (3 + p->hand.joints), s,
                   [&] { return stop.go(caller); });
        });
    });
}

// Finds for every row of x (with base positions) and every solid the nearest sharp point (index `pick`), its distance
// [m], and the gradient of this distance (rows x solids x 3).
int32_t graspd_nearest_features(const Problem* p, int32_t rows, const float* x, int32_t* pick, float* distance,
                                float* gradient, int32_t threads) {
    return guarded([&] {
        for_rows(*p, rows, threads, [&](int row, Scratch& s, bool) {
            const int first = row * p->solids.count;
            nearest_features(*p, x + row * (7 + p->hand.joints), pick + first, distance + first, gradient + 3 * first, s);
        });
    });
}

// Computes for every row of x (with base positions) the least distance of the hand to support and obstacles [m], at
// most `wide`.
int32_t graspd_least_gap(const Problem* p, int32_t rows, const float* x, float wide, float* gap, int32_t threads) {
    return guarded([&] {
        for_rows(*p, rows, threads, [&](int row, Scratch& s, bool) {
            const float* at = x + row * (7 + p->hand.joints);
            float base[12];
            turned_base(at + 3, at, base);
            place_links(p->hand, base, at + 7, s.link);
            gap[row] = least_gap(*p, wide, s);
        });
    });
}

// Computes for every row of joints the greatest depth of the hand's solids in each other [m].
int32_t graspd_self_overlap(const Problem* p, int32_t rows, const float* joints, float* depth, int32_t threads) {
    return guarded([&] {
        for_rows(*p, rows, threads, [&](int row, Scratch& s, bool) {
            depth[row] = self_overlap(*p, joints + row * p->hand.joints, s);
        });
    });
}

// Computes the convex hull of perturbed wrenches (count x 6, at most 256). `out`: distance and unit normal of the facet
// nearest the origin, volume, and error of the planes. The error is infinite if there is no hull.
int32_t graspd_wrench_hull(int32_t count, const double* wrenches, double* out) {
    return guarded([&] {
        WrenchHull hull(wrenches, count);
        out[8] = INFINITY;
        if (!hull.build()) return;
        out[0] = hull.nearest(out + 1);
        out[7] = hull.volume(out + 8);
    });
}

// Builds the tree of a mesh (faces x 9): fewer than 2 nodes per face, and the triangles in the order of the tree.
int32_t graspd_build_surface(int32_t faces, const double* corners, void* nodes, void* triangles) {
    return guarded([&] {
        SurfaceBuilder((const Triangle*)corners, faces, (SurfaceNode*)nodes, (Triangle*)triangles).build();
    });
}

// Computes signed distances of points to a mesh. `order` lists the points such that neighbours follow each other, or is
// null. Distances outside are at most `reach`.
int32_t graspd_signed_distance(const Surface* surface, int32_t count, const double* points, const int32_t* order,
                               double reach, double* out) {
    return guarded([&] {
        SurfaceProbe probe(*surface);
        for (int i = 0; i < count; i++) {
            const int k = order ? order[i] : i;
            out[k] = probe.signed_distance(at(points + 3 * k), reach);
        }
    });
}

// Computes the greatest depth of points in the solids of a hand. `links`: link poses (links x 12). `link_of` (count)
// and `apart` (links x links): see `depth_in_bodies`. Null: all points meet all solids.
int32_t graspd_hand_depth(const Bodies* bodies, const double* links, int32_t count, const double* points,
                          const int32_t* link_of, const uint8_t* apart, double* depth) {
    return guarded([&] { *depth = depth_in_bodies(*bodies, links, count, points, link_of, apart); });
}

// Computes the volume of a hand inside a mesh, with cells of width `cell` [m].
int32_t graspd_shared_volume(const Bodies* bodies, const double* links, const Surface* surface, double cell,
                             double* volume) {
    return guarded([&] { *volume = SharedVolume(*bodies, links, *surface, cell).measure(); });
}
}
