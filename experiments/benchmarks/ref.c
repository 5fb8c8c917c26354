/* A Kalman filter over many runs as one would write it by hand, compiled for one N, M and REAL (see by_hand.py).

Structure of arrays: the batch is the last, contiguous axis of everything, and VEC is a vector of that many runs. F, H, Q
are the same for all runs, R is each run's own. Covariances are lower triangles, k = i (i + 1) / 2 + j. Zeros of F and H
are not exploited; the innovation covariance is factorised. Blocks of VECS vectors go through all steps in the cache, one
thread each. */

#include <math.h>

#define LANES (64 / (int)sizeof(REAL))
#define VECS 4
#define K (N * (N + 1) / 2)
typedef REAL VEC __attribute__((vector_size(64)));
typedef struct {
    VEC x[N], P[K], R[M * (M + 1) / 2], ll;
} State;

#define P_(i, j) P[(i) >= (j) ? (i) * ((i) + 1) / 2 + (j) : (j) * ((j) + 1) / 2 + (i)]

static inline VEC splat(REAL a) {
    VEC v;
    for (int l = 0; l < LANES; l++) v[l] = a;
    return v;
}

static inline VEC map_sqrt(VEC a) {
    for (int l = 0; l < LANES; l++) a[l] = SQRT(a[l]);
    return a;
}

static inline VEC map_log(VEC a) {
    VEC out;
#pragma omp simd
    for (int l = 0; l < LANES; l++) out[l] = LOG(a[l]);
    return out;
}

static inline __attribute__((always_inline)) void step(State *s, const REAL *F, const REAL *H, const REAL *Q,
                                                       const VEC *y) {
    VEC x[N], P[K], T[N][N], B[N][M], L[M][M], e[M], r[M], det = splat(1), nis = splat(0);
#pragma GCC unroll 16
    for (int i = 0; i < N; i++) {
        x[i] = splat(0);
        for (int j = 0; j < N; j++) x[i] += F[i * N + j] * s->x[j];
    }
#pragma GCC unroll 16
    for (int i = 0; i < N; i++)
#pragma GCC unroll 16
        for (int j = 0; j < N; j++) {
            VEC sum = splat(0);
#pragma GCC unroll 16
            for (int l = 0; l < N; l++) sum += F[i * N + l] * s->P_(l, j);
            T[i][j] = sum;
        }
#pragma GCC unroll 16
    for (int i = 0; i < N; i++)
#pragma GCC unroll 16
        for (int j = 0; j <= i; j++) {
            VEC sum = splat(Q[i * N + j]);
#pragma GCC unroll 16
            for (int l = 0; l < N; l++) sum += T[i][l] * F[j * N + l];
            P[i * (i + 1) / 2 + j] = sum;
        }
#pragma GCC unroll 16
    for (int a = 0; a < M; a++) {
        e[a] = y[a];
#pragma GCC unroll 16
        for (int i = 0; i < N; i++) e[a] -= H[a * N + i] * x[i];
#pragma GCC unroll 16
        for (int i = 0; i < N; i++) {
            B[i][a] = splat(0);
#pragma GCC unroll 16
            for (int j = 0; j < N; j++) B[i][a] += P_(i, j) * H[a * N + j];
        }
    }
    /* S = L L'; r are the reciprocals of its diagonal */
#pragma GCC unroll 4
    for (int a = 0; a < M; a++)
#pragma GCC unroll 4
        for (int b = 0; b <= a; b++) {
            VEC sum = s->R[a * (a + 1) / 2 + b];
#pragma GCC unroll 16
            for (int i = 0; i < N; i++) sum += H[a * N + i] * B[i][b];
#pragma GCC unroll 4
            for (int c = 0; c < b; c++) sum -= L[a][c] * L[b][c];
            if (a == b) {
                det *= sum;
                r[a] = 1 / map_sqrt(sum);
            } else
                L[a][b] = sum * r[b];
        }
    /* e <- L^-1 e, B <- B L'^-1, then x += B e and P -= B B' */
#pragma GCC unroll 4
    for (int a = 0; a < M; a++) {
#pragma GCC unroll 4
        for (int c = 0; c < a; c++) e[a] -= L[a][c] * e[c];
        e[a] *= r[a];
        nis += e[a] * e[a];
#pragma GCC unroll 16
        for (int i = 0; i < N; i++) {
#pragma GCC unroll 4
            for (int c = 0; c < a; c++) B[i][a] -= L[a][c] * B[i][c];
            B[i][a] *= r[a];
        }
    }
#pragma GCC unroll 16
    for (int i = 0; i < N; i++) {
        VEC sum = x[i];
#pragma GCC unroll 4
        for (int a = 0; a < M; a++) sum += B[i][a] * e[a];
        s->x[i] = sum;
#pragma GCC unroll 16
        for (int j = 0; j <= i; j++) {
            VEC p = P[i * (i + 1) / 2 + j];
#pragma GCC unroll 4
            for (int a = 0; a < M; a++) p -= B[i][a] * B[j][a];
            s->P[i * (i + 1) / 2 + j] = p;
        }
    }
    s->ll -= (REAL)0.5 * (nis + map_log(det) + (REAL)(M * 1.8378770664093454836));
}

/* runs: a multiple of LANES. ys (T, M, runs), R (M (M + 1) / 2, runs), ll (runs). means (T, N, runs) and covs
(T, K or N N, runs) are written if history is 1 (packed) or 2 (full). */
void filter(long runs, long T, int threads, int history, const REAL *F, const REAL *H, const REAL *Q, const REAL *m0,
            const REAL *P0, const REAL *R, const REAL *ys, REAL *ll, REAL *means, REAL *covs) {
    long vecs = runs / LANES, blocks = (vecs + VECS - 1) / VECS;
#pragma omp parallel for schedule(dynamic) num_threads(threads)
    for (long b = 0; b < blocks; b++) {
        long first = b * VECS, many = vecs - first < VECS ? vecs - first : VECS;
        State state[VECS];
        for (long v = 0; v < many; v++) {
            State *s = &state[v];
            for (int i = 0; i < N; i++) {
                s->x[i] = splat(m0[i]);
                for (int j = 0; j <= i; j++) s->P[i * (i + 1) / 2 + j] = splat(P0[i * N + j]);
            }
            for (int a = 0; a < M * (M + 1) / 2; a++) s->R[a] = *(const VEC *)(R + a * runs + (first + v) * LANES);
            s->ll = splat(0);
        }
        for (long t = 0; t < T; t++)
            for (long v = 0; v < many; v++) {
                State *s = &state[v];
                long at = (first + v) * LANES;
                VEC y[M];
                for (int a = 0; a < M; a++) y[a] = *(const VEC *)(ys + (t * M + a) * runs + at);
                step(s, F, H, Q, y);
                if (history) {
                    for (int i = 0; i < N; i++) *(VEC *)(means + (t * N + i) * runs + at) = s->x[i];
                    if (history == 1)
                        for (int k = 0; k < K; k++) *(VEC *)(covs + (t * K + k) * runs + at) = s->P[k];
                    else
                        for (int i = 0; i < N; i++)
                            for (int j = 0; j < N; j++)
                                *(VEC *)(covs + ((t * N + i) * N + j) * runs + at) = s->P_(i, j);
                }
            }
        for (long v = 0; v < many; v++) *(VEC *)(ll + (first + v) * LANES) = state[v].ll;
    }
}
