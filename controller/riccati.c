// An interior-point method for the tick's program whose linear algebra is a Riccati recursion over
// the horizon: Rao, Wright, Rawlings, J. Optim. Theory Appl. 99, 1998; predictor and corrector:
// Mehrotra, SIAM J. Optim. 2, 1992. It is compiled for one machine and horizon, behind riccati.h and
// definitions of AXES, MOTORS, SOFT, INTERVALS, DRIVEN, BOUNDED (lists of axes), CURVED (0 or 1), KEPT
// (rows of the task's own), and BETWEEN and CUBIC: how many rows of a cubic there are, and three
// numbers each.
//
// A node's variables are y_i = [q_i; v_i; u_i], a stage's are s_i = [u_{i+1}; y_i]:
//
//     minimize    sum of y_i'Q_i y_i / 2 + gradient_i'y_i - u_i' step_i u_{i+1}
//     subject to  [q; v]_{i+1} = G_i s_i + defect_i, v of motors given at the last two nodes
//                 lower <= row - compliance multiplier <= upper
//
// A row is a torque, q + T v of a soft limit, of the cubic to the next node the speed half-way or the
// acceleration with which it begins, or what the task keeps below. Soft limits and the task's own
// rows are compliant: a slack of weight W, which no other row shares, is the multiplier over W.
#include <math.h>
#include <string.h>

#ifndef WIDTH // of vectors, in bytes
#ifdef __AVX512F__
#define WIDTH 64
#else
#define WIDTH 32
#endif
#endif
typedef double vec __attribute__((vector_size(WIDTH), may_alias)); // of what are doubles elsewhere
typedef long long mask __attribute__((vector_size(WIDTH)));

#define VECTORS(count) (((count) + LANES - 1) / LANES)
enum {
    LANES = WIDTH / 8,
    X = 2 * AXES,
    W = MOTORS,
    Y = X + W,
    S = W + Y,
    N = INTERVALS,
    AHEAD = (1 + BETWEEN) * W, // torques come first, then rows of a cubic
    OWN = AHEAD + SOFT,        // the task's
    ROWS = OWN + KEPT,
    SV = VECTORS(S),
    XV = VECTORS(X),
    RV = VECTORS(ROWS),
    SL = SV * LANES, // with padding
    XL = XV * LANES,
    RL = RV * LANES,
    TILE = 4, // rows of a product at a time
    SR = (S + TILE - 1) / TILE * TILE,
    XR = (X + TILE - 1) / TILE * TILE
};

static const int driven[] = DRIVEN, bounded[] = BOUNDED;

// Rows of a cubic: lever (q_{i+1} - q_i) + begins v_i + ends v_{i+1}, a speed, or h times an
// acceleration.
static const struct {
    double lever, begins, ends; // SI
} between[BETWEEN] = CUBIC;

// A bound that is none. An equality gives way by its multiplier over STIFF within a Newton step,
// not in what it converges to.
static const double FREE = 1e6, STIFF = 1e8;
static const double FAR_BELOW = 1e12; // of the task's own rows, whose unit is that of their weight
static const double TO_BOUNDARY = 0.995; // of the way to the first bound
// Found by trying, on arms with 2 and 6 axes: the least distance from a bound at first, and so many
// times the mean product of distances and multipliers that would make the gap in cost.
static const double START_DISTANCE = 0.3, START_PRODUCTS = 10;
// On chains of 8 to 12: of what the guess misses most such a share is the least distance, too. From
// nearer by the first of many rows cuts each step short, so that nothing comes of 30 of them.
static const double START_MISSED = 0.03;
// Of what the task's own rows cost at first so much counts: with more, rows of the largest weights
// leave no accuracy to the others.
static const double BEYOND_MOST = 1e7;

// The stage's matrices, and what eliminating u_{i+1} leaves behind: u_{i+1} = -ahead - gain y_i.
struct stage {
    _Alignas(64) double g[XR][SL];
    double turned[S][XL]; // G'
    double pivot[W][SL];  // rows of the unit triangular factor
    double gain[W][SL];   // zeros for u_{i+1}
    double inverse[W];    // of the pivots
    double ahead[W];
};

struct rows {
    vec at[N + 1][RV];
};

// Lower or upper bounds, how far the rows are from them, multipliers, and steps of both.
struct side {
    struct rows bound, distance, multiplier, distance_step, multiplier_step;
};

struct memory {
    struct stage stages[N];
    _Alignas(64) double h[SR][SL], t[XR][SL]; // of the stage at hand
    double first[W][W], first_inverse[W];     // factor of u_0's own Hessian
    double curved[CURVED ? N + 1 : 1][X][X];
    double diagonal[N + 1][Y], step[N][W];
    double tau[SOFT + 1];     // T, scaled
    double lever[BETWEEN][W]; // scaled
    double y[N + 1][Y], dy[N + 1][Y];
    double slope[N + 1][Y];         // of the cost at y
    double to_go[N + 1][Y];         // of the cost from a node on, of the step
    double still[2][W], rest[2][W]; // speeds at the last two nodes, and their multipliers
    struct rows value, change;      // of the rows at y, and what dy adds
    struct rows weight, push;       // of the rows in the Hessian and the gradient
    struct side sides[2];           // lower, upper
    vec compliance[RV];
    double kept[KEPT ? N + 1 : 1][KEPT + 1][X]; // the task's own rows, scaled; none at first
};

size_t riccati_size(void) { return sizeof(struct memory); }

static inline vec all(double value) { return value - (vec){}; }

static inline vec larger(vec a, vec b) {
    mask first = a > b;
    return (vec)((first & (mask)a) | (~first & (mask)b));
}

static inline double largest(vec v) {
    double most = v[0];
    for (int i = 1; i < LANES; ++i)
        most = v[i] > most ? v[i] : most;
    return most;
}

static inline double sum(vec v) {
    double total = 0;
    for (int i = 0; i < LANES; ++i)
        total += v[i];
    return total;
}

// c[r] = sum over k of a[k][r] b[k], or c[r] less that, for a tile of rows and some vectors of each.
static inline __attribute__((always_inline)) void
tile(int vectors, int depth, int subtract, const double (*a)[SL], const double *b, double *c) {
    vec total[TILE][3];
#pragma GCC unroll 4
    for (int r = 0; r < TILE; ++r)
#pragma GCC unroll 3
        for (int v = 0; v < vectors; ++v)
            total[r][v] = subtract ? *(const vec *)(c + r * SL + v * LANES) : (vec){};
    for (int k = 0; k < depth; ++k) {
        vec row[3];
#pragma GCC unroll 3
        for (int v = 0; v < vectors; ++v)
            row[v] = *(const vec *)(b + k * SL + v * LANES);
#pragma GCC unroll 4
        for (int r = 0; r < TILE; ++r) {
            double factor = subtract ? -a[k][r] : a[k][r];
#pragma GCC unroll 3
            for (int v = 0; v < vectors; ++v)
                total[r][v] += factor * row[v];
        }
    }
#pragma GCC unroll 4
    for (int r = 0; r < TILE; ++r)
#pragma GCC unroll 3
        for (int v = 0; v < vectors; ++v)
            *(vec *)(c + r * SL + v * LANES) = total[r][v];
}

// Rows `from` to `to` of c = a'b, or of c - a'b; of a symmetric one the upper half.
static inline __attribute__((always_inline)) void product(int depth, int subtract, int upper,
                                                          const double (*a)[SL],
                                                          const double (*b)[SL], double (*c)[SL],
                                                          int from, int to) {
    for (int r = from; r < to; r += TILE)
        for (int v = upper ? r / LANES : 0; v < SV; v += 3) {
            const double (*left)[SL] = (const double (*)[SL])(a[0] + r);
            const double *right = b[0] + v * LANES;
            double *target = c[r] + v * LANES;
            switch (SV - v) {
            case 1:
                tile(1, depth, subtract, left, right, target);
                break;
            case 2:
                tile(2, depth, subtract, left, right, target);
                break;
            default:
                tile(3, depth, subtract, left, right, target);
            }
        }
}

// A node's own Hessian, with the rows' weights, onto the upper half of h at [y; y].
static void add_node(struct memory *m, int i) {
    double (*h)[SL] = m->h;
    const double *weight = (const double *)m->weight.at[i], *d = m->diagonal[i];
    for (int j = 0; j < Y; ++j)
        h[W + j][W + j] += d[j];
    for (int j = 0; j < W; ++j) {
        int q = W + driven[j], v = q + AXES;
        for (int k = 0; k < BETWEEN; ++k) {
            double lever = m->lever[k][j], b = between[k].begins, e = between[k].ends;
            int row = (1 + k) * W + j;
            double begins = i < N ? weight[row] : 0;
            double ends = i > 0 ? ((const double *)m->weight.at[i - 1])[row] : 0;
            h[q][q] += lever * lever * (begins + ends);
            h[q][v] += lever * (e * ends - b * begins);
            h[v][v] += b * b * begins + e * e * ends;
        }
        if (i >= N - 1)
            h[v][v] += STIFF;
        h[W + X + j][W + X + j] += weight[j];
    }
    for (int j = 0; j < SOFT; ++j) {
        int q = W + bounded[j], v = q + AXES;
        double by_v = weight[AHEAD + j] * m->tau[j];
        h[q][q] += weight[AHEAD + j];
        h[q][v] += by_v;
        h[v][v] += by_v * m->tau[j];
    }
    for (int k = 0; k < KEPT; ++k)
        for (int r = 0; r < X; ++r) {
            double by_r = weight[OWN + k] * m->kept[i][k][r];
            for (int c = r; c < X; ++c)
                h[W + r][W + c] += by_r * m->kept[i][k][c];
        }
    if (CURVED)
        for (int r = 0; r < X; ++r)
            for (int c = r; c < X; ++c)
                h[W + r][W + c] += m->curved[i][r][c];
}

// Backwards over the horizon: P of [y; y] stands in the lower right of h, and becomes that of the
// node before. Returns 0 if a pivot is not positive, or not a number.
static int factorize(struct memory *m) {
    double (*h)[SL] = m->h, (*t)[SL] = m->t;
    memset(h, 0, sizeof m->h);
    add_node(m, N);
    for (int i = N - 1; i >= 0; --i) {
        struct stage *stage = &m->stages[i];
        const double (*g)[SL] = (const double (*)[SL])stage->g;
        const double *weight = (const double *)m->weight.at[i] + W;
        double coupled[X][W], own[W][W];
        for (int k = 0; k < X; ++k) // mirrored, and P_xu kept
            for (int r = k + 1; r < X; ++r)
                h[W + r][W + k] = h[W + k][W + r];
        for (int k = 0; k < X; ++k)
            for (int j = 0; j < W; ++j)
                coupled[k][j] = h[W + k][W + X + j];
        for (int k = 0; k < W; ++k)
            for (int j = k; j < W; ++j)
                own[k][j] = h[W + X + k][W + X + j];
        // T = P_xx G + E, where E is P_xu for u_{i+1} and, for q_i and v_i, what rows of
        // the cubic couple them with; H = T'G + G'E.
        product(X, 0, 0, (const double (*)[SL])(h[W] + W), g, t, 0, X);
        for (int k = 0; k < X; ++k)
            for (int j = 0; j < W; ++j)
                t[k][j] += coupled[k][j];
        for (int k = 0; k < BETWEEN; ++k)
            for (int j = 0; j < W; ++j) {
                int q = driven[j], v = AXES + q;
                double lever = m->lever[k][j], own = weight[k * W + j];
                double b = own * between[k].begins, e = between[k].ends;
                t[q][W + q] -= lever * lever * own;
                t[q][W + v] += lever * b;
                t[v][W + q] -= lever * own * e;
                t[v][W + v] += e * b;
            }
        product(X, 0, 1, (const double (*)[SL])t, g, h, 0, S);
        for (int r = 0; r < S; ++r)
            for (int k = 0; k < BETWEEN; ++k)
                for (int j = 0; j < W; ++j) {
                    int q = driven[j], v = AXES + q;
                    double lever = m->lever[k][j], e = between[k].ends;
                    double moved = lever * stage->turned[r][q] + e * stage->turned[r][v];
                    double own = weight[k * W + j] * moved;
                    if (W + q >= r)
                        h[r][W + q] -= lever * own;
                    if (W + v >= r)
                        h[r][W + v] += between[k].begins * own;
                }
        for (int r = 0; r < W; ++r) {
            for (int k = 0; k < X; ++k)
                for (int j = 0; j < W; ++j)
                    h[r][j] += stage->turned[r][k] * coupled[k][j];
            for (int j = r; j < W; ++j)
                h[r][j] += own[r][j];
            h[r][W + X + r] -= m->step[i][r];
        }
        add_node(m, i);
        for (int j = 0; j < W; ++j) {
            if (!(h[j][j] > 0))
                return 0;
            double inverse = stage->inverse[j] = 1 / h[j][j];
            for (int c = j / LANES * LANES; c < SL; ++c)
                stage->pivot[j][c] = c < j ? 0 : h[j][c] * inverse;
            for (int r = j + 1; r < W; ++r)
                for (int c = r / LANES * LANES; c < SL; ++c)
                    h[r][c] -= stage->pivot[j][r] * h[j][c];
        }
        for (int j = W - 1; j >= 0; --j) {
            for (int c = 0; c < SL; ++c)
                stage->gain[j][c] = c < W ? 0 : stage->pivot[j][c];
            for (int k = j + 1; k < W; ++k)
                for (int c = 0; c < SL; ++c)
                    stage->gain[j][c] -= stage->pivot[j][k] * stage->gain[k][c];
        }
        double (*rows)[SL] = m->t; // h's first rows are its result's as well
        memcpy(rows, h, sizeof(double[W][SL]));
        product(W, 1, 1, (const double (*)[SL])stage->pivot, (const double (*)[SL])rows, h,
                W / TILE * TILE, S);
    }
    for (int j = 0; j < W; ++j)
        for (int c = j; c < W; ++c)
            m->first[j][c] = h[W + X + j][W + X + c];
    for (int j = 0; j < W; ++j) {
        if (!(m->first[j][j] > 0))
            return 0;
        m->first_inverse[j] = 1 / m->first[j][j];
        for (int r = j + 1; r < W; ++r)
            for (int c = r; c < W; ++c)
                m->first[r][c] -= m->first[j][r] * m->first_inverse[j] * m->first[j][c];
    }
    return 1;
}

// Of node i: the slope, and what the rows push it by.
static inline void gradient_at(const struct memory *m, int i, double *gradient) {
    const double *push = (const double *)m->push.at[i];
    memcpy(gradient, m->slope[i], sizeof(double[Y]));
    for (int j = 0; j < W; ++j) {
        int q = driven[j], v = AXES + q;
        for (int k = 0; k < BETWEEN; ++k) {
            int row = (1 + k) * W + j;
            double begins = i < N ? push[row] : 0;
            double ends = i > 0 ? ((const double *)m->push.at[i - 1])[row] : 0;
            gradient[q] += m->lever[k][j] * (ends - begins);
            gradient[v] += between[k].begins * begins + between[k].ends * ends;
        }
        if (i >= N - 1)
            gradient[v] += m->rest[i - N + 1][j];
        gradient[X + j] += push[j];
    }
    for (int j = 0; j < SOFT; ++j) {
        gradient[bounded[j]] += push[AHEAD + j];
        gradient[AXES + bounded[j]] += push[AHEAD + j] * m->tau[j];
    }
    for (int k = 0; k < KEPT; ++k)
        for (int c = 0; c < X; ++c)
            gradient[c] += push[OWN + k] * m->kept[i][k][c];
}

// h = G'p + [p_u; 0], of s = [u_{i+1}; y_i].
static inline void back(const struct stage *stage, const double *p, double *h) {
    vec total[SV] = {};
    for (int k = 0; k < X; ++k)
        for (int v = 0; v < SV; ++v)
            total[v] += p[k] * *(const vec *)(stage->g[k] + v * LANES);
    memcpy(h, total, sizeof total);
    for (int j = 0; j < W; ++j)
        h[j] += p[X + j];
}

// x = G s.
static inline void advance(const struct stage *stage, const double *s, double *x) {
    vec total[XV] = {};
    for (int c = 0; c < S; ++c)
        for (int v = 0; v < XV; ++v)
            total[v] += s[c] * *(const vec *)(stage->turned[c] + v * LANES);
    memcpy(x, total, sizeof(double[X]));
}

// By the factors: the step dy that minimizes, with slope and pushes as gradient. x_0 is given.
static void substitute(struct memory *m) {
    _Alignas(64) double h[SL], s[SL] = {};
    for (int i = N; i >= 0; --i) {
        double *p = m->to_go[i];
        gradient_at(m, i, p);
        if (i >= N - 1)
            for (int j = 0; j < W; ++j) {
                int v = AXES + driven[j];
                p[v] += STIFF * (m->y[i][v] - m->still[i - N + 1][j]);
            }
        if (i == N)
            continue;
        struct stage *stage = &m->stages[i];
        back(stage, m->to_go[i + 1], h);
        for (int j = 0; j < Y; ++j)
            h[W + j] += p[j];
        for (int j = 0; j < W; ++j) {
            double first = h[j];
            for (int v = j / LANES; v < SV; ++v)
                *(vec *)(h + v * LANES) -= first * *(const vec *)(stage->pivot[j] + v * LANES);
            h[j] = first;
        }
        for (int j = W - 1; j >= 0; --j) {
            stage->ahead[j] = h[j] * stage->inverse[j];
            for (int k = j + 1; k < W; ++k)
                stage->ahead[j] -= stage->pivot[j][k] * stage->ahead[k];
        }
        memcpy(p, h + W, sizeof(double[Y]));
    }
    double *u = m->dy[0] + X, *p = m->to_go[0] + X;
    for (int j = 0; j < W; ++j)
        for (int k = 0; k < j; ++k)
            p[j] -= m->first[k][j] * m->first_inverse[k] * p[k];
    for (int j = W - 1; j >= 0; --j) {
        u[j] = -p[j] * m->first_inverse[j];
        for (int k = j + 1; k < W; ++k)
            u[j] -= m->first[j][k] * m->first_inverse[j] * u[k];
    }
    memset(m->dy[0], 0, sizeof(double[X]));
    for (int i = 0; i < N; ++i) {
        struct stage *stage = &m->stages[i];
        double *next = m->dy[i + 1] + X;
        memcpy(s + W, m->dy[i], sizeof(double[Y]));
        for (int j = 0; j < W; ++j) {
            vec total = {};
            for (int v = 0; v < SV; ++v)
                total += *(const vec *)(stage->gain[j] + v * LANES) * *(const vec *)(s + v * LANES);
            next[j] = -stage->ahead[j] - sum(total);
        }
        memcpy(s, next, sizeof(double[W]));
        advance(stage, s, m->dy[i + 1]);
    }
}

static void rows_of(const struct memory *m, const double (*y)[Y], struct rows *rows) {
    for (int i = 0; i <= N; ++i) {
        double *row = (double *)rows->at[i];
        for (int j = 0; j < W; ++j) {
            int q = driven[j], v = AXES + q;
            row[j] = y[i][X + j];
            for (int k = 0; k < BETWEEN; ++k)
                row[(1 + k) * W + j] = i < N ? m->lever[k][j] * (y[i + 1][q] - y[i][q]) +
                                                   between[k].begins * y[i][v] +
                                                   between[k].ends * y[i + 1][v]
                                             : 0;
        }
        for (int j = 0; j < SOFT; ++j)
            row[AHEAD + j] = y[i][bounded[j]] + m->tau[j] * y[i][AXES + bounded[j]];
        for (int k = 0; k < KEPT; ++k) {
            row[OWN + k] = 0;
            for (int c = 0; c < X; ++c)
                row[OWN + k] += m->kept[i][k][c] * y[i][c];
        }
    }
}

// The slope grows by the Hessian times a share of dy.
static void add_slope(struct memory *m, const double (*dy)[Y], double share) {
    for (int i = 0; i <= N; ++i) {
        double *slope = m->slope[i];
        for (int j = 0; j < Y; ++j)
            slope[j] += share * m->diagonal[i][j] * dy[i][j];
        for (int j = 0; j < W; ++j) {
            if (i < N)
                slope[X + j] -= share * m->step[i][j] * dy[i + 1][X + j];
            if (i > 0)
                slope[X + j] -= share * m->step[i - 1][j] * dy[i - 1][X + j];
        }
        if (CURVED)
            for (int r = 0; r < X; ++r)
                for (int c = 0; c < X; ++c)
                    slope[r] += share * m->curved[i][r][c] * dy[i][c];
    }
}

int riccati_update(void *memory, const struct riccati_problem *p) {
    struct memory *m = memory;
    const double *scale = p->column_scale, *torque = scale + X * (N + 1);
    double inverse[X];
    for (int r = 0; r < X; ++r)
        inverse[r] = 1 / scale[r];
    for (int i = 0; i < N; ++i) {
        struct stage *stage = &m->stages[i];
        const double *a = p->a + i * X * X, *b0 = p->b0 + i * X * AXES, *b1 = p->b1 + i * X * AXES;
        for (int c = 0; c < S; ++c) {
            int state = c - W, u = state < 0 ? c : c - W - X;
            const double *column = state < 0   ? b1 + driven[u] * X
                                   : state < X ? a + state * X
                                               : b0 + driven[u] * X;
            double unit = 0 <= state && state < X ? scale[state] : torque[u];
            for (int r = 0; r < X; ++r)
                stage->g[r][c] = stage->turned[c][r] = column[r] * unit * inverse[r];
        }
        memcpy(m->step[i], p->step + i * W, sizeof(double[W]));
    }
    for (int i = 0; i <= N; ++i) {
        memcpy(m->diagonal[i], p->state + i * X, sizeof(double[X]));
        for (int j = 0; j < W; ++j)
            m->diagonal[i][X + j] = p->torque[i * W + j] + (i < N ? m->step[i][j] : 0) +
                                    (i > 0 ? m->step[i - 1][j] : 0);
        for (int r = 0; CURVED && r < X; ++r)
            for (int c = 0; c < X; ++c)
                m->curved[i][r][c] = p->curvature[(i * X + c) * X + r] * scale[c] * scale[r];
    }
    for (int j = 0; j < SOFT; ++j) {
        int axis = bounded[j];
        m->tau[j] = p->approach_s[axis] * scale[AXES + axis] / scale[axis];
        ((double *)m->compliance)[AHEAD + j] = 1 / (2 * p->soft[axis] * scale[axis] * scale[axis]);
    }
    for (int k = 0; k < KEPT; ++k) { // a slack costs its square
        ((double *)m->compliance)[OWN + k] = 0.5;
        for (int i = 1; i <= N; ++i)
            for (int c = 0; c < X; ++c)
                m->kept[i][k][c] = p->kept_slope[((i - 1) * X + c) * KEPT + k] * scale[c];
    }
    for (int k = 0; k < BETWEEN; ++k)
        for (int j = 0; j < W; ++j) {
            int q = driven[j];
            m->lever[k][j] = between[k].lever * scale[q] / scale[AXES + q];
        }
    memset(&m->weight, 0, sizeof m->weight);
    return factorize(m);
}

// What the estimate decides, in the rows' units.
static void take_vectors(struct memory *m, const struct riccati_problem *p) {
    const double *scale = p->column_scale, *torque = scale + X * (N + 1);
    const double *low = p->lower, *up = p->upper;
    const int rest = X * (N + 1), torques = rest + 2 * W, speeds = torques + W * (N + 1);
    const int above = speeds + BETWEEN * W * N, below = above + SOFT * N;
    for (int i = 0; i <= N; ++i) {
        double *lower = (double *)m->sides[0].bound.at[i];
        double *upper = (double *)m->sides[1].bound.at[i];
        for (int r = 0; r < RL; ++r)
            lower[r] = -FREE, upper[r] = FREE;
        for (int j = 0; j < W; ++j) {
            double unit = 1 / scale[AXES + driven[j]], of_torque = 1 / torque[j];
            int at = torques + i * W + j;
            lower[j] = low[at] / p->row_scale[at] * of_torque;
            upper[j] = up[at] / p->row_scale[at] * of_torque;
            if (i >= N - 1) {
                int row = rest + (i - N + 1) * W + j;
                m->still[i - N + 1][j] = low[row] / p->row_scale[row] * unit;
            }
            for (int k = 0; i < N && k < BETWEEN; ++k) {
                int row = speeds + (k * N + i) * W + j;
                double by = unit / p->row_scale[row];
                lower[(1 + k) * W + j] = low[row] * by;
                upper[(1 + k) * W + j] = up[row] * by;
            }
        }
        for (int j = 0; i > 0 && j < SOFT; ++j) {
            int row = (i - 1) * SOFT + j;
            double unit = 1 / (p->row_scale[above + row] * scale[bounded[j]]);
            lower[AHEAD + j] = -up[below + row] * unit;
            upper[AHEAD + j] = up[above + row] * unit;
        }
        for (int k = 0; i > 0 && k < KEPT; ++k) {
            lower[OWN + k] = -FAR_BELOW;
            upper[OWN + k] = -p->kept[(i - 1) * KEPT + k];
        }
        memcpy(m->slope[i], p->gradient + i * X, sizeof(double[X]));
        memcpy(m->slope[i] + X, p->gradient + (N + 1) * X + i * W, sizeof(double[W]));
    }
    memset(m->rest, 0, sizeof m->rest);
    memset(&m->push, 0, sizeof m->push);
}

// y: the guess's torques, and the motion that the linearized dynamics make of them.
static void roll_out(struct memory *m, const struct riccati_problem *p) {
    double s[S] = {};
    memset(m->y, 0, sizeof m->y);
    memcpy(m->y[0], p->lower, sizeof(double[X]));
    for (int i = 0; i < N; ++i) {
        memcpy(s + W, m->y[i], sizeof(double[Y]));
        advance(&m->stages[i], s, m->y[i + 1]);
        for (int j = 0; j < X; ++j)
            m->y[i + 1][j] += p->lower[X * (i + 1) + j];
    }
    add_slope(m, (const double (*)[Y])m->y, 1);
    rows_of(m, (const double (*)[Y])m->y, &m->value);
}

// What the guess pays for the task's own rows.
static inline double beyond(const struct memory *m) {
    double cost = 0;
    for (int i = 1; i <= N; ++i)
        for (int k = OWN; k < ROWS; ++k) {
            double off =
                ((const double *)m->value.at[i])[k] - ((const double *)m->sides[1].bound.at[i])[k];
            cost += off > 0 ? off * off : 0;
        }
    return cost;
}

static void take_step(struct memory *m, double share) {
    for (int k = 0; k < 2; ++k)
        for (int j = 0; j < W; ++j) {
            int i = N - 1 + k, v = AXES + driven[j];
            m->rest[k][j] += share * STIFF * (m->y[i][v] + m->dy[i][v] - m->still[k][j]);
        }
    for (int i = 0; i <= N; ++i)
        for (int j = 0; j < Y; ++j)
            m->y[i][j] += share * m->dy[i][j];
    add_slope(m, (const double (*)[Y])m->dy, share);
}

// Whether all limits hold a whole step on.
static int within(const struct memory *m) {
    vec most = all(-FREE);
    for (int i = 0; i <= N; ++i)
        for (int v = 0; v < RV; ++v) {
            vec value = m->value.at[i][v] + m->change.at[i][v];
            most = larger(most, larger(m->sides[0].bound.at[i][v] - value,
                                       value - m->sides[1].bound.at[i][v]));
        }
    return largest(most) <= 0;
}

// By how much the guess misses a bound at most. The task's own rows, whose unit may be any, do not
// count: their slacks are cheap.
static double missed_most(const struct memory *m) {
    double most = 0;
    for (int i = 0; i <= N; ++i)
        for (int r = 0; r < OWN; ++r) {
            double value = ((const double *)m->value.at[i])[r];
            most = fmax(most, ((const double *)m->sides[0].bound.at[i])[r] - value);
            most = fmax(most, value - ((const double *)m->sides[1].bound.at[i])[r]);
        }
    return most;
}

// Distances and multipliers to begin with.
static void start(struct memory *m, double product) {
    vec least = all(fmax(START_DISTANCE, START_MISSED * missed_most(m)));
    for (int k = 0; k < 2; ++k) {
        struct side *side = &m->sides[k];
        for (int i = 0; i <= N; ++i)
            for (int v = 0; v < RV; ++v) {
                vec off = m->value.at[i][v] - side->bound.at[i][v];
                vec distance = larger(k ? -off : off, least);
                side->distance.at[i][v] = distance;
                side->multiplier.at[i][v] = product / distance;
                side->distance_step.at[i][v] = side->multiplier_step.at[i][v] = (vec){};
            }
    }
}

// How far a row misses bound + distance, as far as its multiplier does not make it comply.
static inline vec missed(const struct memory *m, int k, int i, int v) {
    const struct side *side = &m->sides[k];
    vec off = m->value.at[i][v] - side->bound.at[i][v];
    return (k ? off : -off) - m->compliance[v] * side->multiplier.at[i][v] +
           side->distance.at[i][v];
}

// By how much a step is to reduce a row's product; `corrects`: what the last step's quadratic term
// would make of it counts.
static inline vec excess(const struct side *side, double aim, int corrects, int i, int v) {
    vec product = side->distance.at[i][v] * side->multiplier.at[i][v] - aim;
    if (corrects)
        product += side->distance_step.at[i][v] * side->multiplier_step.at[i][v];
    return product;
}

// The rows' weights and pushes for a step that takes their products to `aim`: distances and
// multipliers are eliminated.
static inline __attribute__((always_inline)) void weigh(struct memory *m, double aim,
                                                        int corrects) {
    for (int i = 0; i <= N; ++i)
        for (int v = 0; v < RV; ++v) {
            vec weight = {}, push = {};
            for (int k = 0; k < 2; ++k) {
                struct side *side = &m->sides[k];
                vec multiplier = side->multiplier.at[i][v];
                vec inverse = 1 / (side->distance.at[i][v] + multiplier * m->compliance[v]);
                vec own = multiplier * inverse;
                vec by = multiplier + own * missed(m, k, i, v) -
                         excess(side, aim, corrects, i, v) * inverse;
                weight += own;
                push += k ? by : -by;
            }
            m->weight.at[i][v] = weight;
            m->push.at[i][v] = push;
        }
}

// Steps of distances and multipliers to a step dy, which `weigh` was called for. Returns the
// largest share of it, up to one, that keeps all of them from going below zero.
static inline __attribute__((always_inline)) double follow(struct memory *m, double aim,
                                                           int corrects) {
    vec most = {};
    rows_of(m, (const double (*)[Y])m->dy, &m->change);
    for (int i = 0; i <= N; ++i)
        for (int v = 0; v < RV; ++v)
            for (int k = 0; k < 2; ++k) {
                struct side *side = &m->sides[k];
                vec distance = side->distance.at[i][v], multiplier = side->multiplier.at[i][v];
                vec change = m->change.at[i][v], compliance = m->compliance[v];
                vec off = missed(m, k, i, v) + (k ? change : -change);
                vec step = (multiplier * off - excess(side, aim, corrects, i, v)) /
                           (distance + multiplier * compliance);
                side->multiplier_step.at[i][v] = step;
                side->distance_step.at[i][v] = compliance * step - off;
                most =
                    larger(most, larger((off - compliance * step) / distance, -step / multiplier));
            }
    double most_of_any = largest(most);
    return most_of_any > 1 ? 1 / most_of_any : 1;
}

// Of distance and multiplier, a share of their steps on: the mean over all rows, and the largest.
static double products(const struct memory *m, double share, double *most) {
    vec total = {}, top = {};
    for (int k = 0; k < 2; ++k) {
        const struct side *side = &m->sides[k];
        for (int i = 0; i <= N; ++i)
            for (int v = 0; v < RV; ++v) {
                vec product = (side->distance.at[i][v] + share * side->distance_step.at[i][v]) *
                              (side->multiplier.at[i][v] + share * side->multiplier_step.at[i][v]);
                total += product;
                top = larger(top, product);
            }
    }
    *most = largest(top);
    return sum(total) / (2 * (N + 1) * RL);
}

static void follow_through(struct memory *m, double share) {
    take_step(m, share);
    for (int i = 0; i <= N; ++i)
        for (int v = 0; v < RV; ++v) {
            m->value.at[i][v] += share * m->change.at[i][v];
            for (int k = 0; k < 2; ++k) {
                struct side *side = &m->sides[k];
                side->distance.at[i][v] += share * side->distance_step.at[i][v];
                side->multiplier.at[i][v] += share * side->multiplier_step.at[i][v];
            }
        }
}

// Predictor and corrector, until products and what the rows miss are small.
static void iterate(struct memory *m, int max_iterations, double tolerance,
                    struct riccati_answer *answer) {
    double missing = 1, largest_product; // missing: of what the rows missed at first
    for (;; ++answer->iterations) {
        double mean = products(m, 0, &answer->complementarity);
        answer->good = answer->complementarity <= tolerance && missing <= tolerance;
        if (answer->good || answer->iterations == max_iterations)
            return;
        weigh(m, 0, 0);
        if (!factorize(m))
            return;
        substitute(m);
        double share = follow(m, 0, 0);
        double ratio = products(m, share, &largest_product) / mean;
        double aim = ratio * ratio * ratio * mean;
        weigh(m, aim, 1);
        substitute(m);
        share = follow(m, aim, 1);
        share = share < 1 ? TO_BOUNDARY * share : 1;
        follow_through(m, share);
        missing *= 1 - share;
    }
}

// How far the torques are from optimal by the multipliers at hand; those of the dynamics are such
// that the states are.
static double stationarity(struct memory *m, const struct riccati_problem *p) {
    const double *torque = p->column_scale + X * (N + 1);
    _Alignas(64) double h[SL] = {};
    double at[Y], most = 0;
    for (int i = N; i >= 0; --i) {
        gradient_at(m, i, at);
        for (int j = 0; i < N && j < Y; ++j)
            at[j] += h[W + j];
        if (i > 0)
            back(&m->stages[i - 1], at, h);
        for (int j = 0; j < W; ++j) {
            double slope = fabs(i > 0 ? h[j] : at[X + j]) / torque[j];
            most = slope > most ? slope : most;
        }
    }
    return most;
}

struct riccati_answer riccati_solve(void *memory, const struct riccati_problem *p, double *z,
                                    int max_iterations, double tolerance) {
    struct memory *m = memory;
    struct riccati_answer answer = {0, 0, 0, 0};
    take_vectors(m, p);
    roll_out(m, p);
    substitute(m); // with the factors of `riccati_update`: as if there were no limits
    rows_of(m, (const double (*)[Y])m->dy, &m->change);
    if (within(m)) {
        take_step(m, 1);
        if (KEPT) // for their slacks
            rows_of(m, (const double (*)[Y])m->y, &m->value);
        answer.good = 1;
    } else {
        double gap = 0; // in cost, between the guess and that
        for (int i = 0; i <= N; ++i)
            for (int j = 0; j < Y; ++j)
                gap -= m->slope[i][j] * m->dy[i][j] / 2;
        if (KEPT)
            gap += fmin(beyond(m), BEYOND_MOST);
        start(m, START_PRODUCTS * fmax(gap, 1) / (2 * N * ROWS));
        iterate(m, max_iterations, tolerance, &answer);
        for (int i = 0; i <= N; ++i)
            for (int v = 0; v < RV; ++v)
                m->push.at[i][v] =
                    m->sides[1].multiplier.at[i][v] - m->sides[0].multiplier.at[i][v];
    }
    answer.stationarity = stationarity(m, p);
    for (int i = 0; i <= N; ++i) {
        memcpy(z + i * X, m->y[i], sizeof(double[X]));
        memcpy(z + X * (N + 1) + i * W, m->y[i] + X, sizeof(double[W]));
    }
    memset(z + Y * (N + 1), 0, sizeof(double[AXES])); // slacks of soft limits stay here
    double *slack = z + Y * (N + 1) + AXES;
    for (int i = 1; i <= N; ++i)
        for (int k = 0; k < KEPT; ++k) {
            const double *value = (const double *)m->value.at[i];
            const double *upper = (const double *)m->sides[1].bound.at[i];
            *slack++ = fmax(value[OWN + k] - upper[OWN + k], 0);
        }
    return answer;
}
