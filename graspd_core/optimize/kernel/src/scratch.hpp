// Memory of one thread for all its evaluations, allocated once from the sizes of the problem.
#pragma once
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <new>

#include "lanes.hpp"
#include "layout.hpp"

namespace graspd {

// An array of `count` zeros, aligned for vectors. A vector may begin at the last element.
template <class T>
class Array {
   public:
    explicit Array(int count) {
        size_t bytes = (sizeof(T) * (size_t)count + 4 * LANES + 63) / 64 * 64;
        data_ = (T*)std::aligned_alloc(64, bytes);
        if (!data_) throw std::bad_alloc();
        memset((void*)data_, 0, bytes);
    }
    ~Array() { std::free(data_); }
    Array(const Array&) = delete;
    Array& operator=(const Array&) = delete;
    operator T*() { return data_; }
    operator const T*() const { return data_; }

   private:
    T* data_;
};

// Points in the object frame, their signed distances and normals, and intermediate values for the adjoints.
struct Samples {
    explicit Samples(int n)
        : x(n), y(n), z(n), phi(n), nx(n), ny(n), nz(n), fx(n), fy(n), fz(n), ox(n), oy(n), oz(n), cell(n),
          channel{Array<float>(n), Array<float>(n), Array<float>(n), Array<float>(n)}, slopes(12 * n),
          a_phi(n), a_nx(n), a_ny(n), a_nz(n), gx(n), gy(n), gz(n) {}
    Array<float> x, y, z;        // positions [m]
    Array<float> phi, nx, ny, nz;
    Array<float> fx, fy, fz;     // position in the cell
    Array<float> ox, oy, oz;     // offset from the grid [m], zero inside
    Array<int32_t> cell;         // index of the cell's first node
    Array<float> channel[4];     // interpolated channels
    Array<float> slopes;         // 12 per point: slopes of the channels per cell along x, y, z
    Array<float> a_phi, a_nx, a_ny, a_nz;  // adjoints of distance and normal
    Array<float> gx, gy, gz;     // gradient with respect to the points
};

// Candidates of the wrench resistance term, and values for each disturbance at each candidate.
struct Task {
    Task(int n, int directions)
        : index(n), ax(n), ay(n), az(n), nx(n), ny(n), nz(n), s(n), known(n), cx(n), cy(n), cz(n),
          normal_speed(n * directions), inverse_speed(n * directions), resisted(n * directions),
          support(LANES * directions), slope(directions), gax(n), gay(n), gaz(n), gnx(n), gny(n), gnz(n), gs(n) {}
    Array<int32_t> index;
    Array<float> ax, ay, az, nx, ny, nz, s;  // arm, normal, activation
    Array<float> known, cx, cy, cz;          // confidences and their gradients
    Array<float> normal_speed, inverse_speed, resisted;
    Array<float> support, slope;
    Array<float> gax, gay, gaz, gnx, gny, gnz, gs;  // gradients of arm, normal, activation
    int count = 0;
};

// Successive sharp points lie near each other. A block is a vector of them, with its middle and radius.
struct Blocks {
    explicit Blocks(const Object& object)
        : count((object.feature_count + LANES - 1) / LANES), x(padded(count)), y(padded(count)), z(padded(count)),
          reach(padded(count)) {
        const float *fx = object.features, *fy = fx + object.feature_stride, *fz = fy + object.feature_stride;
        for (int b = 0; b < count; b++) {
            const int first = b * LANES, end = std::min(first + LANES, object.feature_count);
            for (int i = first; i < end; i++) {
                x[b] += fx[i] / (end - first);
                y[b] += fy[i] / (end - first);
                z[b] += fz[i] / (end - first);
            }
            for (int i = first; i < end; i++)
                reach[b] = std::max(reach[b], hypotf(hypotf(fx[i] - x[b], fy[i] - y[b]), fz[i] - z[b]));
        }
    }
    int count;
    Array<float> x, y, z, reach;  // [m]
};

// A sharp point of the object, and a solid near the point.
struct Pair {
    int32_t solid, feature;
    float distance, gradient[3], adjoint;
};

struct Scratch {
    explicit Scratch(const Problem& p)
        : link(12 * p.hand.links),
          wrench(6 * p.hand.links),
          candidates(padded(std::max(p.coarse.count, p.fine.count))),
          key(padded(std::max(p.coarse.count, p.fine.count))),
          task(padded(std::min(p.task_points, std::max(p.coarse.count, p.fine.count))), p.directions),
          gap(p.hand.groups), gap_at(p.hand.groups), gap_pair(p.hand.groups),
          solid(12 * p.solids.count),
          middle{Array<float>(padded(p.solids.count)), Array<float>(padded(p.solids.count)),
                 Array<float>(padded(p.solids.count))},
          blocks(p.object),
          bound(p.solids.count * blocks.count * LANES), bounded(p.solids.count * blocks.count),
          picked(p.feature_pairs), pair(p.feature_pairs),
          sphere(padded(p.spheres.centers.count)),
          obstacle(padded(std::max(p.obstacles.corners.count, p.obstacles.spheres.count))) {}
    Array<float> link;    // T_object_link
    Array<float> wrench;  // force on each link, and moment about the origin of the object frame
    Samples candidates;
    Array<float> key;
    Task task;
    Array<float> gap;          // least distance of each group
    Array<int32_t> gap_at, gap_pair;  // candidate or pair with the least distance
    Array<float> solid;        // T_object_solid
    Array<float> middle[3];    // middles of the solids
    Blocks blocks;
    Array<float> bound;        // lower bounds of distance for pairs of solids and blocks
    Array<int32_t> bounded;    // first pair of each vector of bounds
    float cut_of_task = 0, cut_of_pairs = INFINITY;  // largest key of the last choice
    Array<int32_t> picked;
    Array<Pair> pair;
    Samples sphere, obstacle;
    float terms[TERMS];
};

}  // namespace graspd
