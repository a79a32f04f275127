// The lower bound: the same work as textbook.cpp in AVX-512 or AVX2 intrinsics, for square grids.

#include "bound_bend.hpp"
#include "bound_grid.hpp"
#include "bound_line.hpp"

#include <type_traits>

namespace {

// Call make with run-time flags as types.
template <class Make>
auto choose(Make make) {
    return make();
}

template <class Make, class... Flags>
auto choose(Make make, bool flag, Flags... flags) {
    return flag ? choose([&](auto... rest) { return make(std::true_type(), rest...); }, flags...)
                : choose([&](auto... rest) { return make(std::false_type(), rest...); }, flags...);
}

}    // namespace

extern "C" {

int lanes(int bits) { return bits == 32 ? Lanes<float>::count : Lanes<double>::count; }

// strip: rows that are swept together; n for all
Grid *grid_new(int bits, int estimate, int strip, int n, const double *inv_mass,
               const double *rest_length, const double *compliance, double gravity) {
    return choose([&](auto single, auto estimates) -> Grid * {
        using T = std::conditional_t<single, float, double>;
        return new GridOf<T, estimates>(n, strip, inv_mass, rest_length, compliance, gravity);
    }, bits == 32, estimate != 0);
}

void grid_delete(Grid *grid) { delete grid; }

void grid_set(Grid *grid, const double *x, const double *v) { grid->set(x, v); }

void grid_get(const Grid *grid, double *x, double *v) { grid->get(x, v); }

int grid_order(const Grid *grid, std::int32_t *pairs) { return grid->order(pairs); }

void grid_advance(Grid *grid, int substeps, double h) { grid->advance(substeps, h); }

Lines *lines_new(int bits, int estimate, int along, int n, double h, const double *inv_mass,
                 const double *rest_length, const double *compliance) {
    return choose([&](auto single, auto estimates, auto rows) -> Lines * {
        using T = std::conditional_t<single, float, double>;
        return new LinesOf<T, estimates, rows>(n, h, inv_mass, rest_length, compliance);
    }, bits == 32, estimate != 0, along != 0);
}

void lines_delete(Lines *lines) { delete lines; }

void lines_set(Lines *lines, const double *x) { lines->set(x); }

void lines_get(const Lines *lines, double *x, double *lambda) { lines->get(x, lambda); }

void lines_solve(Lines *lines, int passes) { lines->solve(passes); }

Bend *bend_new(int bits, int n, const double *inv_mass) {
    if (bits == 32) return new BendOf<float>(n, inv_mass);
    return new BendOf<double>(n, inv_mass);
}

void bend_delete(Bend *bend) { delete bend; }

void bend_set(Bend *bend, const double *x) { bend->set(x); }

void bend_get(const Bend *bend, double *x) { bend->get(x); }

int bend_order(const Bend *bend, std::int32_t *particles) { return bend->order(particles); }

void bend_weigh(Bend *bend, const double *k, double alpha) { bend->weigh(k, alpha); }

void bend_project(Bend *bend, int passes) { bend->project(passes); }

}    // extern "C"
