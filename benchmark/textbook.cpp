// The textbook: XPBD as one writes it down from the papers. Particles are structs in an array, the
// constraints are projected one after the other in the order given, one thread, nothing clever.
//
// M. Macklin, M. Müller, N. Chentanez, "XPBD", 2016, algorithm 1, eq 17 and 18; substeps of
// Macklin et al., "Small steps in physics simulation", 2019; bending of M. Bergou et al., "A
// quadratic bending model for inextensible surfaces", 2006, as a linear vector constraint.
//
// Also a leapfrog on the same particles and edges: no constraint solver in it, so it can say what
// the others should converge to.

#include <cmath>
#include <cstdint>
#include <vector>

namespace {

template <class T>
struct Vector {
    T x, y, z;
};

template <class T>
Vector<T> operator+(Vector<T> a, Vector<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }

template <class T>
Vector<T> operator-(Vector<T> a, Vector<T> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }

template <class T>
Vector<T> operator*(T s, Vector<T> a) { return {s * a.x, s * a.y, s * a.z}; }

template <class T>
T length(Vector<T> a) { return std::sqrt(a.x * a.x + a.y * a.y + a.z * a.z); }

template <class T>
struct Particle {
    Vector<T> x, x_prev, v;    // [m], [m], [m/s]
    T w;                       // inverse mass [1/kg]; 0 while pinned
};

template <class T>
struct Edge {    // C = |xi - xj| - rest
    int i, j;
    T rest, compliance, lambda;    // [m], [m/N], [N s²]
};

template <class T>
struct Hinge {    // C = Σ k x, a vector
    int particle[4];
    T k[4];                // [1/m]
    T compliance;          // [1/(N m)]
    Vector<T> lambda;
};

struct Cloth {    // in either precision
    virtual ~Cloth() = default;
    virtual void add_edges(int count, const std::int32_t *pairs, const double *rest,
                           const double *compliance) = 0;
    virtual void add_hinges(int count, const std::int32_t *particles, const double *k,
                            const double *compliance) = 0;
    virtual void set(const double *x, const double *v) = 0;
    virtual void get(double *x, double *v) const = 0;
    virtual void advance(int frames, double dt, int substeps, int iterations) = 0;
    virtual void project(int passes, double h) = 0;
    virtual void leapfrog(int frames, double dt, int substeps) = 0;
};

template <class T>
class ClothOf final : public Cloth {
    std::vector<Particle<T>> particles;
    std::vector<Edge<T>> edges;
    std::vector<Hinge<T>> hinges;
    Vector<T> gravity;

public:
    ClothOf(int count, const double *inv_mass, const double *g)
        : particles(count), gravity{T(g[0]), T(g[1]), T(g[2])} {
        for (int i = 0; i < count; ++i) particles[i].w = T(inv_mass[i]);
    }

    void add_edges(int count, const std::int32_t *pairs, const double *rest,
                   const double *compliance) override {
        for (int c = 0; c < count; ++c)
            edges.push_back({pairs[2 * c], pairs[2 * c + 1], T(rest[c]), T(compliance[c]), T(0)});
    }

    void add_hinges(int count, const std::int32_t *particle, const double *k,
                    const double *compliance) override {
        for (int c = 0; c < count; ++c, particle += 4, k += 4)
            hinges.push_back({{particle[0], particle[1], particle[2], particle[3]},
                              {T(k[0]), T(k[1]), T(k[2]), T(k[3])}, T(compliance[c]), {}});
    }

    void set(const double *x, const double *v) override {
        for (auto &p : particles) {
            p.x = p.x_prev = {T(x[0]), T(x[1]), T(x[2])};
            p.v = {T(v[0]), T(v[1]), T(v[2])};
            x += 3, v += 3;
        }
    }

    void get(double *x, double *v) const override {
        for (const auto &p : particles) {
            x[0] = p.x.x, x[1] = p.x.y, x[2] = p.x.z;
            v[0] = p.v.x, v[1] = p.v.y, v[2] = p.v.z;
            x += 3, v += 3;
        }
    }

    void advance(int frames, double dt, int substeps, int iterations) override {
        const T h = T(dt / substeps);
        for (int k = 0; k < frames * substeps; ++k) {
            for (auto &p : particles) {
                if (p.w == T(0)) continue;
                p.v = p.v + h * gravity;
                p.x_prev = p.x;
                p.x = p.x + h * p.v;
            }
            release();
            for (int i = 0; i < iterations; ++i) sweep(h);
            for (auto &p : particles) {
                if (p.w == T(0)) continue;
                p.v = (T(1) / h) * (p.x - p.x_prev);
            }
        }
    }

    void project(int passes, double h) override {
        release();
        for (int k = 0; k < passes; ++k) sweep(T(h));
    }

    void leapfrog(int frames, double dt, int substeps) override {
        const T h = T(dt / substeps);
        for (int k = 0; k < frames * substeps; ++k) {
            kick(T(0.5) * h);
            for (auto &p : particles)
                if (p.w > T(0)) p.x = p.x + h * p.v;
            kick(T(0.5) * h);
        }
    }

private:
    void release() {
        for (auto &e : edges) e.lambda = T(0);
        for (auto &q : hinges) q.lambda = {};
    }

    void sweep(T h) {
        const T inv_h2 = T(1) / (h * h);
        for (auto &q : hinges) project(q, inv_h2);
        for (auto &e : edges) project(e, inv_h2);
    }

    void project(Edge<T> &e, T inv_h2) {
        Particle<T> &a = particles[e.i], &b = particles[e.j];
        const Vector<T> d = a.x - b.x;
        const T l = length(d), w = a.w + b.w, alpha = e.compliance * inv_h2;
        if (l == T(0) || w == T(0)) return;
        const T dl = -(l - e.rest + alpha * e.lambda) / (w + alpha);
        e.lambda += dl;
        const Vector<T> step = (dl / l) * d;
        a.x = a.x + a.w * step;
        b.x = b.x - b.w * step;
    }

    void project(Hinge<T> &q, T inv_h2) {
        T w = T(0);
        Vector<T> c = {};
        for (int k = 0; k < 4; ++k) {
            const Particle<T> &p = particles[q.particle[k]];
            w += p.w * q.k[k] * q.k[k];
            c = c + q.k[k] * p.x;
        }
        if (w == T(0)) return;
        const T alpha = q.compliance * inv_h2;
        const Vector<T> dl = (T(-1) / (w + alpha)) * (c + alpha * q.lambda);
        q.lambda = q.lambda + dl;
        for (int k = 0; k < 4; ++k) {
            Particle<T> &p = particles[q.particle[k]];
            p.x = p.x + (p.w * q.k[k]) * dl;
        }
    }

    void kick(T h) {    // v += h (g + w F), F = -C / compliance along each edge
        for (auto &p : particles)
            if (p.w > T(0)) p.v = p.v + h * gravity;
        for (const auto &e : edges) {
            Particle<T> &a = particles[e.i], &b = particles[e.j];
            const Vector<T> d = a.x - b.x;
            const T l = length(d);
            const Vector<T> impulse = (-h * (l - e.rest) / (e.compliance * l)) * d;
            a.v = a.v + a.w * impulse;
            b.v = b.v - b.w * impulse;
        }
    }
};

}    // namespace

extern "C" {

Cloth *cloth_new(int bits, int count, const double *inv_mass, const double *gravity) {
    if (bits == 32) return new ClothOf<float>(count, inv_mass, gravity);
    return new ClothOf<double>(count, inv_mass, gravity);
}

void cloth_delete(Cloth *cloth) { delete cloth; }

void cloth_edges(Cloth *cloth, int count, const std::int32_t *pairs, const double *rest,
                 const double *compliance) {
    cloth->add_edges(count, pairs, rest, compliance);
}

void cloth_hinges(Cloth *cloth, int count, const std::int32_t *particles, const double *k,
                  const double *compliance) {
    cloth->add_hinges(count, particles, k, compliance);
}

void cloth_set(Cloth *cloth, const double *x, const double *v) { cloth->set(x, v); }

void cloth_get(const Cloth *cloth, double *x, double *v) { cloth->get(x, v); }

// whole steps: predict, project, velocities
void cloth_advance(Cloth *cloth, int frames, double dt, int substeps, int iterations) {
    cloth->advance(frames, dt, substeps, iterations);
}

// projections only, the multipliers zeroed once
void cloth_project(Cloth *cloth, int passes, double h) { cloth->project(passes, h); }

void cloth_leapfrog(Cloth *cloth, int frames, double dt, int substeps) {
    cloth->leapfrog(frames, dt, substeps);
}

}    // extern "C"
