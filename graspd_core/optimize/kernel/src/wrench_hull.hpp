// The convex hull of wrenches, one point after the other (Barber, Dobkin and Huhdanpaa, The Quickhull Algorithm, 1996).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace graspd {

// The hull of at most 256 points in general position in six dimensions: the caller joggles them.
class WrenchHull {
   public:
    static constexpr int D = 6;
    static constexpr double FACTORIAL = 720;

    WrenchHull(const double* points, int count) : points_(points), count_(count) {}

    // Whether there is a hull with volume, and rounding has not spoilt it.
    bool build() {
        int simplex[D + 1];
        if (!first_simplex(simplex)) return false;
        for (int i : simplex)
            for (int d = 0; d < D; d++) middle_[d] += at(i)[d] / (D + 1);
        std::vector<bool> used(count_, false);
        for (int i = 0; i <= D; i++) {
            used[simplex[i]] = true;
            Facet facet;
            for (int j = 0, k = 0; j <= D; j++)
                if (j != i) facet.neighbor[k] = j, facet.vertex[k++] = uint8_t(simplex[j]);
            if (!set_first_plane(add(facet))) return false;
        }
        for (int i = 0; i < count_ && !broken_; i++)
            if (!used[i]) insert(i);
        return !broken_;
    }

    // Of the facet nearest the origin: its outward unit normal, and its distance, negative where the origin is outside.
    double nearest(double* normal) const {
        int best = -1;
        for (int f = 0; f < int(facets_.size()); f++)
            if (alive(f) && (best < 0 || plane_[D][f] < plane_[D][best])) best = f;
        for (int d = 0; d < D; d++) normal[d] = plane_[d][best];
        return plane_[D][best];
    }

    // The volume. `error` is the largest distance of a vertex from the plane of its facet.
    double volume(double* error) const {
        double sum = *error = 0;
        for (int f = 0; f < int(facets_.size()); f++) {
            if (!alive(f)) continue;
            double rows[D][D];
            for (int i = 0; i < D; i++) {
                const double* p = at(facets_[f].vertex[i]);
                *error = std::max(*error, std::fabs(height(f, p)));
                for (int d = 0; d < D; d++) rows[i][d] = p[d] - middle_[d];
            }
            sum += std::fabs(determinant(rows));
        }
        return sum / FACTORIAL;
    }

   private:
    // Vertices stand in the order in which they came. Neighbor k lies across the ridge without vertex k.
    struct Facet {
        uint8_t vertex[D];
        int32_t neighbor[D];
    };
    // A ridge of new facets, by its four old vertices, and the facet that came with it first.
    struct Ridge {
        uint32_t key;
        int32_t facet, side;
    };
    static constexpr int DEAD = -1, CLOSED = -1;

    const double* at(int i) const { return points_ + D * i; }
    bool alive(int f) const { return facets_[f].neighbor[0] != DEAD; }

    int add(const Facet& facet) {
        if (free_.empty()) {
            facets_.push_back(facet);
            for (auto& row : plane_) row.push_back(0);
            return int(facets_.size()) - 1;
        }
        const int f = free_.back();
        free_.pop_back();
        facets_[f] = facet;
        return f;
    }

    // Its place is used again. Until then no point is above it.
    void remove(int f) {
        facets_[f].neighbor[0] = DEAD;
        for (auto& row : plane_) row[f] = 0;
        plane_[D][f] = INFINITY;
        free_.push_back(f);
    }

    void set_plane(int f, const double* plane) {
        double square = 0;
        for (int d = 0; d < D; d++) square += plane[d] * plane[d];
        for (int d = 0; d <= D; d++) plane_[d][f] = plane[d] / std::sqrt(square);
    }

    double height(int f, const double* p) const {
        double sum = -plane_[D][f];
        for (int d = 0; d < D; d++) sum += plane_[d][f] * p[d];
        return sum;
    }

    // Seven points, each the farthest from the flat through those before it.
    bool first_simplex(int* chosen) const {
        std::vector<double> rest(points_, points_ + D * count_);
        chosen[0] = 0;
        for (int i = 0; i < count_; i++)
            if (at(i)[0] < at(chosen[0])[0]) chosen[0] = i;
        for (int i = 0; i < D * count_; i++) rest[i] -= at(chosen[0])[i % D];
        for (int k = 1; k <= D; k++) {
            double most = 0;
            for (int i = 0; i < count_; i++) {
                double square = 0;
                for (int d = 0; d < D; d++) square += rest[D * i + d] * rest[D * i + d];
                if (square > most) most = square, chosen[k] = i;
            }
            if (!(most > 0)) return false;
            double axis[D];
            for (int d = 0; d < D; d++) axis[d] = rest[D * chosen[k] + d] / std::sqrt(most);
            for (int i = 0; i < count_; i++) {
                double along = 0;
                for (int d = 0; d < D; d++) along += rest[D * i + d] * axis[d];
                for (int d = 0; d < D; d++) rest[D * i + d] -= along * axis[d];
            }
        }
        return true;
    }

    // The plane of a facet of the first simplex, by cofactors.
    bool set_first_plane(int f) {
        const uint8_t* vertex = facets_[f].vertex;
        double plane[D + 1] = {};
        for (int d = 0; d < D; d++) {
            double rows[D][D] = {};
            rows[0][d] = 1;
            for (int i = 1; i < D; i++)
                for (int e = 0; e < D; e++) rows[i][e] = at(vertex[i])[e] - at(vertex[0])[e];
            plane[d] = determinant(rows);
            plane[D] += plane[d] * at(vertex[0])[d];
        }
        set_plane(f, plane);
        const double side = height(f, middle_);
        for (auto& row : plane_) row[f] = side > 0 ? -row[f] : row[f];
        return side != 0 && std::isfinite(side);
    }

    // Facets that see the point give way to those between it and their rim.
    void insert(int index) {
        measure_heights(at(index));
        seen_.clear();
        made_.clear();
        for (int f = 0; f < int(height_.size()); f++)
            if (height_[f] > 0) seen_.push_back(f);
        for (int f : seen_)
            for (int k = 0; k < D; k++)
                if (const int beyond = facets_[f].neighbor[k]; height_[beyond] <= 0) add_cone(index, f, k, beyond);
        for (int f : made_) exchange(facets_[f].neighbor[D - 1], -2 - f, f);
        for (int f : seen_) remove(f);
        connect();
    }

    void measure_heights(const double* p) {
        const int total = int(facets_.size());
        height_.resize(total);
        for (int f = 0; f < total; f++) height_[f] = -plane_[D][f];
        for (int d = 0; d < D; d++)
            for (int f = 0; f < total; f++) height_[f] += plane_[d][f] * p[d];
    }

    // A facet from the ridge without vertex k of facet f, which the one beyond shares, to a new vertex.
    void add_cone(int index, int f, int k, int beyond) {
        // A plane through the ridge is a sum of the planes that meet there.
        double plane[D + 1];
        for (int d = 0; d <= D; d++) plane[d] = height_[f] * plane_[d][beyond] - height_[beyond] * plane_[d][f];
        Facet facet = facets_[f];
        std::copy(facet.vertex + k + 1, facet.vertex + D, facet.vertex + k);
        facet.vertex[D - 1] = uint8_t(index);
        std::fill(facet.neighbor, facet.neighbor + D, 0);
        facet.neighbor[D - 1] = beyond;
        const int made = add(facet);
        set_plane(made, plane);
        made_.push_back(made);
        height_.resize(facets_.size());
        // Marked, not set: the one beyond may meet two facets that see the point.
        exchange(beyond, f, -2 - made);
    }

    // Puts another neighbor in the place of one.
    void exchange(int f, int32_t one, int32_t other) {
        int32_t *neighbor = facets_[f].neighbor, *place = std::find(neighbor, neighbor + D, one);
        if (place == neighbor + D)
            broken_ = true;
        else
            *place = other;
    }

    // New facets are neighbors where they share a ridge: four old vertices and the new one.
    void connect() {
        int bits = 6;
        while ((size_t(1) << bits) < 2 * (D - 1) * made_.size()) bits++;
        const uint32_t last = (uint32_t(1) << bits) - 1;
        ridges_.assign(size_t(last) + 1, Ridge{0, DEAD, 0});
        size_t open = (D - 1) * made_.size();
        for (int f : made_)
            for (int k = 0; k < D - 1; k++) {
                uint32_t key = 0;
                for (int i = 0; i < D - 1; i++)
                    if (i != k) key = key << 8 | facets_[f].vertex[i];
                uint32_t slot = key * 2654435769u >> (32 - bits);
                while (ridges_[slot].facet != DEAD && ridges_[slot].key != key) slot = (slot + 1) & last;
                Ridge& ridge = ridges_[slot];
                if (ridge.facet == DEAD) {
                    ridge = {key, f, k};
                } else if (ridge.side != CLOSED) {
                    facets_[f].neighbor[k] = ridge.facet;
                    facets_[ridge.facet].neighbor[ridge.side] = f;
                    ridge.side = CLOSED;
                    open -= 2;
                }
            }
        // Rounding can leave a ridge to one facet, or to three.
        broken_ |= open != 0;
    }

    static double determinant(double (&rows)[D][D]) {
        double product = 1;
        for (int c = 0; c < D; c++) {
            int best = c;
            for (int r = c + 1; r < D; r++)
                if (std::fabs(rows[r][c]) > std::fabs(rows[best][c])) best = r;
            if (rows[best][c] == 0) return 0;
            if (best != c) std::swap(rows[best], rows[c]), product = -product;
            product *= rows[c][c];
            for (int r = c + 1; r < D; r++) {
                const double factor = rows[r][c] / rows[c][c];
                for (int e = c + 1; e < D; e++) rows[r][e] -= factor * rows[c][e];
            }
        }
        return product;
    }

    const double* points_;
    int count_;
    double middle_[D] = {};
    std::vector<Facet> facets_;
    std::vector<double> plane_[D + 1];  // outward unit normals, and offsets
    std::vector<double> height_;        // of the point above each facet
    std::vector<int> free_, seen_, made_;
    std::vector<Ridge> ridges_;
    bool broken_ = false;
};

}  // namespace graspd
