// One level of the paper's scheme on our tables, as a person would write it in C++: the peer of `bench_refine.py`.
//
//     g++ -O3 -march=native -ffast-math -fopenmp -shared -fPIC gathers.cpp -o gathers.so
//
// Values lie in one array for all levels: the old vertices are there, the new ones are written after them.

#include <cmath>

using Index = const int;
using Row = float[3];

static inline void unit(const float *v, float *out) {
    const float squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    const float scale = squared > 0 ? 1 / std::sqrt(squared) : 0;
    for (int c = 0; c < 3; ++c) out[c] = v[c] * scale;
}

// Adds (b - a) x (c - d) to the sum: twice the vector area of a quad a, d, b, c.
static inline void add_cross(const float *a, const float *b, const float *c, const float *d, float *sum) {
    const float u0 = b[0] - a[0], u1 = b[1] - a[1], u2 = b[2] - a[2];
    const float v0 = c[0] - d[0], v1 = c[1] - d[1], v2 = c[2] - d[2];
    sum[0] += u1 * v2 - u2 * v1;
    sum[1] += u2 * v0 - u0 * v2;
    sum[2] += u0 * v1 - u1 * v0;
}

extern "C" void refine_level(int n_old, int n_edges, int n_quads, int width, Index *edges, Index *wings, Index *quads,
                             Index *quad_edges, float h, bool with_normals, Row *x, Row *n) {
    Row *x_edge = x + n_old, *x_face = x_edge + n_edges, *n_edge = n + n_old, *n_face = n_edge + n_edges;
#pragma omp parallel
    {
#pragma omp for
        for (int e = 0; e < n_edges; ++e) {  // eqs. (1) and (2)
            const float *a = x[edges[2 * e]], *b = x[edges[2 * e + 1]];
            const float *n_a = n[edges[2 * e]], *n_b = n[edges[2 * e + 1]];
            float along_a = 0, along_b = 0;
            for (int c = 0; c < 3; ++c) {
                along_a += n_a[c] * (b[c] - a[c]);
                along_b += n_b[c] * (b[c] - a[c]);
            }
            for (int c = 0; c < 3; ++c)
                x_edge[e][c] = 0.5f * (a[c] + b[c]) + h / 8 * (along_b * n_b[c] - along_a * n_a[c]);
        }
#pragma omp for
        for (int q = 0; q < n_quads; ++q)  // eq. (3), zero twist
            for (int c = 0; c < 3; ++c) {
                float sum = 0, corners = 0;
                for (int i = 0; i < 4; ++i) {
                    sum += x_edge[quad_edges[4 * q + i]][c];
                    corners += x[quads[4 * q + i]][c];
                }
                x_face[q][c] = 0.5f * sum - 0.25f * corners;
            }
        if (with_normals) {
#pragma omp for
            for (int e = 0; e < n_edges; ++e) {  // eqs. (4) to (6), by the ring's vector area
                const float *a = x[edges[2 * e]], *b = x[edges[2 * e + 1]];
                Index *wing = wings + width * e;
                float sum[3] = {0, 0, 0};
                if (width == 2) {
                    add_cross(b, a, x[wing[1]], x[wing[0]], sum);
                } else {
                    add_cross(b, x[wing[1]], a, x[wing[0]], sum);
                    add_cross(b, x[wing[2]], x[wing[3]], a, sum);
                }
                unit(sum, n_edge[e]);
            }
#pragma omp for
            for (int q = 0; q < n_quads; ++q) {
                Index *s = quad_edges + 4 * q;
                float sum[3] = {0, 0, 0};
                add_cross(x_edge[s[0]], x_edge[s[2]], x_edge[s[3]], x_edge[s[1]], sum);
                unit(sum, n_face[q]);
            }
        }
    }
}
