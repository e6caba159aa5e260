// A C++ twin of the error-state filter: same predict, same gates, same sequential Joseph updates, same output rows, written
// apart from the package's kernels and from the equations. Sixteen error states: attitude (body), velocity, position (NED), gyro
// bias, accelerometer bias, barometer offset. No queue, no alignment, no aid records: measurements come with no delay.
//
// Fixed sizes, no allocation, one row of P is two or four SIMD registers. Compiled by twin.py: g++ -O3 -march=native.

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

constexpr int N = 16, WIDTH = 37;
constexpr int THETA = 0, VEL = 3, POS = 6, BG = 9, BA = 12, BARO = 15;
constexpr double DEG = M_PI / 180.0;
constexpr double ABSENT = 1e18;

struct Vec {
    double x, y, z;
};
struct Quat {
    double w, x, y, z;
};
struct Mat {
    double m[3][3];
};

inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(double k, Vec a) { return {k * a.x, k * a.y, k * a.z}; }
inline Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec load(const double* p) { return {p[0], p[1], p[2]}; }
inline Vec operator*(const Mat& c, Vec a) {
    return {c.m[0][0] * a.x + c.m[0][1] * a.y + c.m[0][2] * a.z, c.m[1][0] * a.x + c.m[1][1] * a.y + c.m[1][2] * a.z,
            c.m[2][0] * a.x + c.m[2][1] * a.y + c.m[2][2] * a.z};
}

inline Quat operator*(Quat a, Quat b) {
    return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}

inline Quat unit(Quat q) {
    const double k = 1.0 / std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    return {k * q.w, k * q.x, k * q.y, k * q.z};
}

// Exact quaternion of a rotation vector.
inline Quat exponential(Vec r) {
    const double angle2 = dot(r, r);
    double c, s;
    if (angle2 < 0.01) {  // Taylor, exact to rounding
        const double h2 = 0.25 * angle2;
        c = 1.0 - h2 / 2.0 * (1.0 - h2 * (1.0 / 12.0) * (1.0 - h2 * (1.0 / 30.0) * (1.0 - h2 * (1.0 / 56.0))));
        s = 0.5 - h2 * (1.0 / 12.0) * (1.0 - h2 * (1.0 / 20.0) * (1.0 - h2 * (1.0 / 42.0) * (1.0 - h2 * (1.0 / 72.0))));
    } else {
        const double angle = std::sqrt(angle2);
        c = std::cos(0.5 * angle);
        s = std::sin(0.5 * angle) / angle;
    }
    return {c, s * r.x, s * r.y, s * r.z};
}

inline Mat dcm(Quat q) {
    const double ww = q.w * q.w, xx = q.x * q.x, yy = q.y * q.y, zz = q.z * q.z;
    const double xy = q.x * q.y, xz = q.x * q.z, yz = q.y * q.z, wx = q.w * q.x, wy = q.w * q.y, wz = q.w * q.z;
    return {{{ww + xx - yy - zz, 2.0 * (xy - wz), 2.0 * (xz + wy)},
             {2.0 * (xy + wz), ww - xx + yy - zz, 2.0 * (yz - wx)},
             {2.0 * (xz - wy), 2.0 * (yz + wx), ww - xx - yy + zz}}};
}

inline double wrap(double a) { return a - 2.0 * M_PI * std::ceil((a - M_PI) / (2.0 * M_PI)); }

}  // namespace

extern "C" {

// Filled field by field from Python: names and order as in twin.py.
struct Parameters {
    double noise_gyro, noise_accel, noise_gyro_bias, noise_accel_bias, noise_baro_bias;
    double noise_gnss_velocity, noise_gnss_position, noise_gnss_altitude, noise_gnss_velocity_min, noise_gnss_position_min;
    double noise_barometer, noise_magnetometer;
    double gate_gnss, gate_barometer, gate_magnetometer;
    double timeout_gnss, timeout_barometer, timeout_magnetometer;
    double arm_gnss_x, arm_gnss_y, arm_gnss_z;
    double field_tolerance_strength, field_tolerance_dip;
    double declination, dip, strength;
    double lat, lon, alt, gravity;
    double imu_mean;
};

struct State {
    double t;
    double q[4];
    double v[3], p[3], bg[3], ba[3], baro;
    double P[N][N];
    double t_passed[4];
    int64_t n_fused[4], n_rejected[4];
};

}  // extern "C"

namespace {

// A row of H: up to three blocks of three columns.
struct Row {
    int blocks;
    int column[3];
    double h[3][3];
};

struct Filter {
    alignas(64) double P[N][N];
    alignas(64) double dx[N];
    double t;
    Quat q;
    Vec v, p, bg, ba, w;
    double baro;
    Parameters prm;
    double tan_dip_n, tan_dip_e, meridian, transverse;
    double t_passed[4];
    int64_t n_fused[4], n_rejected[4];

    void begin(const State& s, const Parameters& parameters) {
        prm = parameters;
        std::copy(&s.P[0][0], &s.P[0][0] + N * N, &P[0][0]);
        std::fill(dx, dx + N, 0.0);
        t = s.t;
        q = {s.q[0], s.q[1], s.q[2], s.q[3]};
        v = load(s.v), p = load(s.p), bg = load(s.bg), ba = load(s.ba);
        w = {0.0, 0.0, 0.0};
        baro = s.baro;
        tan_dip_n = std::tan(prm.dip) * std::cos(prm.declination);
        tan_dip_e = std::tan(prm.dip) * std::sin(prm.declination);
        const double s_lat = std::sin(prm.lat * DEG), a = 6378137.0, e2 = 6.69437999014e-3;
        const double w2 = 1.0 - e2 * s_lat * s_lat, root = std::sqrt(w2);
        meridian = a * (1.0 - e2) / (w2 * root) + prm.alt;
        transverse = a / root + prm.alt;
        for (int k = 0; k < 4; ++k) t_passed[k] = s.t_passed[k], n_fused[k] = s.n_fused[k], n_rejected[k] = s.n_rejected[k];
    }

    void end(State& s) const {
        std::copy(&P[0][0], &P[0][0] + N * N, &s.P[0][0]);
        s.t = t;
        s.q[0] = q.w, s.q[1] = q.x, s.q[2] = q.y, s.q[3] = q.z;
        const Vec* from[4] = {&v, &p, &bg, &ba};
        double* to[4] = {s.v, s.p, s.bg, s.ba};
        for (int k = 0; k < 4; ++k) to[k][0] = from[k]->x, to[k][1] = from[k]->y, to[k][2] = from[k]->z;
        s.baro = baro;
        for (int k = 0; k < 4; ++k) s.t_passed[k] = t_passed[k], s.n_fused[k] = n_fused[k], s.n_rejected[k] = n_rejected[k];
    }

    // P <- F P in the first columns: rows 0-8 change, the rest of F is one.
    template <int COLUMNS>
    void left(const Mat& D, const Mat& A, const Mat& B, double dt) {
        for (int j = 0; j < COLUMNS; ++j) {
            const double t0 = P[0][j], t1 = P[1][j], t2 = P[2][j], b0 = P[12][j], b1 = P[13][j], b2 = P[14][j];
            double d[3];
            for (int i = 0; i < 3; ++i)
                d[i] = A.m[i][0] * t0 + A.m[i][1] * t1 + A.m[i][2] * t2 + B.m[i][0] * b0 + B.m[i][1] * b1 + B.m[i][2] * b2;
            for (int i = 0; i < 3; ++i) {
                P[POS + i][j] += dt * (P[VEL + i][j] + 0.5 * d[i]);
                P[VEL + i][j] += d[i];
            }
            for (int i = 0; i < 3; ++i) P[i][j] = D.m[i][0] * t0 + D.m[i][1] * t1 + D.m[i][2] * t2 - dt * P[BG + i][j];
        }
    }

    // P <- F P F'. The columns of F' from 9 on are those of one: F P is final there, the rows below follow by symmetry, and only
    // the first nine columns of (F P)' are multiplied again.
    void congruence(const Mat& D, const Mat& A, const Mat& B, double dt) {
        left<N>(D, A, B, dt);
        for (int i = 0; i < BG; ++i)
            for (int j = 0; j < i; ++j) std::swap(P[i][j], P[j][i]);
        for (int i = BG; i < N; ++i)
            for (int j = 0; j < BG; ++j) P[i][j] = P[j][i];
        left<BG>(D, A, B, dt);
    }

    void predict(Vec w0, Vec f0, Vec w1, Vec f1, double dt) {
        const Vec b = w1 - bg, g = f1 - ba;
        Vec rate = b, force = g, rotation, dv;
        if (prm.imu_mean > 0.0) {
            rotation = dt * b;
            dv = dt * g;
        } else {  // linear course between the samples: trapezoid, coning, sculling
            const Vec a = w0 - bg, h = f0 - ba;
            const double k = dt * dt / 12.0;
            rate = 0.5 * (a + b);
            force = 0.5 * (h + g);
            rotation = dt * rate + k * cross(a, b);
            dv = dt * force + k * (cross(a, g) + cross(h, b));
        }
        const Quat half = exponential(0.5 * rotation), middle = q * half;
        const Mat C = dcm(middle);
        q = unit(middle * half);
        Vec a = C * dv;
        a.z += prm.gravity * dt;
        p = p + dt * (v + 0.5 * a);
        v = v + a;
        w = rate;

        const Mat D = dcm(exponential(-1.0 * rotation));
        const Vec f = dt * force;
        Mat A, B;
        for (int i = 0; i < 3; ++i) {
            A.m[i][0] = C.m[i][2] * f.y - C.m[i][1] * f.z;
            A.m[i][1] = C.m[i][0] * f.z - C.m[i][2] * f.x;
            A.m[i][2] = C.m[i][1] * f.x - C.m[i][0] * f.y;
            for (int j = 0; j < 3; ++j) B.m[i][j] = -dt * C.m[i][j];
        }
        congruence(D, A, B, dt);

        const double qg = prm.noise_gyro * prm.noise_gyro, qa = prm.noise_accel * prm.noise_accel;
        const double qbg = prm.noise_gyro_bias * prm.noise_gyro_bias, qba = prm.noise_accel_bias * prm.noise_accel_bias;
        for (int i = 0; i < 3; ++i) {
            P[THETA + i][THETA + i] += qg * dt + qbg * dt * dt * dt / 3.0;
            P[VEL + i][VEL + i] += qa * dt;
            P[POS + i][POS + i] += qa * dt * dt * dt / 3.0;
            P[BG + i][BG + i] += qbg * dt;
            P[BA + i][BA + i] += qba * dt;
        }
        P[BARO][BARO] += prm.noise_baro_bias * prm.noise_baro_bias * dt;
        if (dt > 0.02) {
            const double c_bg = -0.5 * qbg * dt * dt, c_p = 0.5 * qa * dt * dt, c_ba = -0.5 * qba * dt * dt;
            for (int i = 0; i < 3; ++i) {
                P[THETA + i][BG + i] += c_bg, P[BG + i][THETA + i] += c_bg;
                P[VEL + i][POS + i] += c_p, P[POS + i][VEL + i] += c_p;
                for (int j = 0; j < 3; ++j) P[VEL + i][BA + j] += c_ba * C.m[i][j], P[BA + j][VEL + i] += c_ba * C.m[i][j];
            }
        }
    }

    // u = H P from the rows of P.
    void rows_of(const Row& H, double* u) const {
        for (int j = 0; j < N; ++j) u[j] = 0.0;
        for (int b = 0; b < H.blocks; ++b) {
            const double *r0 = P[H.column[b]], *r1 = P[H.column[b] + 1], *r2 = P[H.column[b] + 2];
            for (int j = 0; j < N; ++j) u[j] += H.h[b][0] * r0[j] + H.h[b][1] * r1[j] + H.h[b][2] * r2[j];
        }
    }

    static double times(const Row& H, const double* u) {
        double total = 0.0;
        for (int b = 0; b < H.blocks; ++b) {
            const double* x = u + H.column[b];
            total += H.h[b][0] * x[0] + H.h[b][1] * x[1] + H.h[b][2] * x[2];
        }
        return total;
    }

    // One scalar update in Joseph form for any gain: P <- (1 - k h) P (1 - k h)' + r k k'. Row by row, since row i of
    // (1 - k h) P needs row i of P and h P alone.
    void update(const Row& H, double r, double e, bool vertical) {
        alignas(64) double u[N], k[N];
        rows_of(H, u);
        const double S = times(H, u) + r, inverse = 1.0 / S;
        for (int i = 0; i < N; ++i) k[i] = times(H, P[i]) * inverse;
        if (vertical) {
            const Mat C = dcm(q);
            const Vec d = {C.m[2][0], C.m[2][1], C.m[2][2]};
            const double a = dot(d, load(k)), b = dot(d, load(k + BG));
            std::fill(k, k + N, 0.0);
            k[0] = a * d.x, k[1] = a * d.y, k[2] = a * d.z;
            k[BG] = b * d.x, k[BG + 1] = b * d.y, k[BG + 2] = b * d.z;
        }
        e -= times(H, dx);
        for (int i = 0; i < N; ++i) {
            double* row = P[i];
            const double ki = k[i];
            dx[i] += ki * e;
            for (int j = 0; j < N; ++j) row[j] -= ki * u[j];
            const double c = r * ki - times(H, row);
            for (int j = 0; j < N; ++j) row[j] += c * k[j];
        }
    }

    void inject() {
        const Vec turn = load(dx);
        q = unit(q * exponential(turn));
        v = v + load(dx + VEL);
        p = p + load(dx + POS);
        bg = bg + load(dx + BG);
        ba = ba + load(dx + BA);
        baro += dx[BARO];
        for (int j = 0; j < N; ++j) {
            const Vec c = cross(turn, {P[0][j], P[1][j], P[2][j]});
            P[0][j] -= 0.5 * c.x, P[1][j] -= 0.5 * c.y, P[2][j] -= 0.5 * c.z;
        }
        for (int i = 0; i < N; ++i) {
            const Vec c = cross(turn, {P[i][0], P[i][1], P[i][2]});
            P[i][0] -= 0.5 * c.x, P[i][1] -= 0.5 * c.y, P[i][2] -= 0.5 * c.z;
        }
        std::fill(dx, dx + N, 0.0);
    }

    void symmetrise() {
        for (int i = 0; i < N; ++i)
            for (int j = 0; j < i; ++j) P[i][j] = P[j][i] = 0.5 * (P[i][j] + P[j][i]);
    }

    // Test up to three components together, then fuse them one after the other.
    void fuse(int sensor, double t_valid, int n, const Row* H, const double* z, const double* h, double* r, double gate, double timeout,
              bool refused, bool vertical) {
        double e[3], u[N], nis, s_ii[3];
        bool there[3];
        for (int i = 0; i < n; ++i) {
            there[i] = z[i] == z[i];
            e[i] = there[i] ? z[i] - h[i] : 0.0;
            if (!there[i]) r[i] = ABSENT;
        }
        if (n == 1) {
            rows_of(H[0], u);
            s_ii[0] = times(H[0], u) + r[0];
            nis = e[0] * e[0] / s_ii[0];
        } else {
            rows_of(H[0], u);
            const double s00 = times(H[0], u) + r[0], s01 = times(H[1], u), s02 = times(H[2], u);
            rows_of(H[1], u);
            const double s11 = times(H[1], u) + r[1], s12 = times(H[2], u);
            rows_of(H[2], u);
            const double s22 = times(H[2], u) + r[2];
            const double l10 = s01 / s00, l20 = s02 / s00, d1 = s11 - l10 * s01, l21 = (s12 - l10 * s02) / d1;
            const double d2 = s22 - l20 * s02 - l21 * (s12 - l10 * s02);
            const double y0 = e[0], y1 = e[1] - l10 * y0, y2 = e[2] - l20 * y0 - l21 * y1;
            nis = y0 * y0 / s00 + y1 * y1 / d1 + y2 * y2 / d2;
            s_ii[0] = s00, s_ii[1] = s11, s_ii[2] = s22;
        }
        const double ratio = nis / (gate * gate);
        if (refused) {
            ++n_rejected[sensor];
            return;
        }
        if (ratio <= 1.0) {
            t_passed[sensor] = t_valid;
        } else if (t_valid - t_passed[sensor] > timeout) {  // let in again at the edge of the gate
            for (int i = 0; i < n; ++i) r[i] += s_ii[i] * (ratio - 1.0);
        } else {
            ++n_rejected[sensor];
            return;
        }
        ++n_fused[sensor];
        for (int i = 0; i < n; ++i)
            if (there[i]) update(H[i], r[i], e[i], vertical);
        inject();
        symmetrise();
    }

    // Row i of k C [a]x.
    static void lever(const Mat& C, Vec a, double k, int i, double* out) {
        out[0] = k * (C.m[i][1] * a.z - C.m[i][2] * a.y);
        out[1] = k * (C.m[i][2] * a.x - C.m[i][0] * a.z);
        out[2] = k * (C.m[i][0] * a.y - C.m[i][1] * a.x);
    }

    void gnss_velocity(double stamp, const double* z, const double* r_given) {
        const Vec arm = {prm.arm_gnss_x, prm.arm_gnss_y, prm.arm_gnss_z};
        const Mat C = dcm(q);
        const Vec swing = cross(w, arm), offset = C * swing;
        const double h[3] = {v.x + offset.x, v.y + offset.y, v.z + offset.z};
        const double floor = prm.noise_gnss_velocity_min * prm.noise_gnss_velocity_min;
        const double fallback = prm.noise_gnss_velocity * prm.noise_gnss_velocity;
        Row H[3];
        double r[3];
        for (int i = 0; i < 3; ++i) {
            r[i] = r_given[i] >= 0.0 ? std::max(r_given[i], floor) : fallback;
            H[i] = {3, {THETA, VEL, BG}, {}};
            lever(C, swing, -1.0, i, H[i].h[0]);
            H[i].h[1][i] = 1.0;
            lever(C, arm, 1.0, i, H[i].h[2]);
        }
        fuse(0, stamp, 3, H, z, h, r, prm.gate_gnss, prm.timeout_gnss, false, false);
    }

    void gnss_position(double stamp, const double* fix, const double* r_given, double dt) {
        double dlon = fix[1] - prm.lon;
        dlon -= 360.0 * std::floor((dlon + 180.0) / 360.0);
        const double z[3] = {(fix[0] - prm.lat) * DEG * meridian, dlon * DEG * transverse * std::cos(0.5 * (fix[0] + prm.lat) * DEG),
                             prm.alt - fix[2]};
        const Vec arm = {prm.arm_gnss_x, prm.arm_gnss_y, prm.arm_gnss_z};
        const Mat C = dcm(q);
        const Vec offset = C * arm;
        const double h[3] = {p.x + offset.x, p.y + offset.y, p.z + offset.z};
        const double floor = prm.noise_gnss_position_min * prm.noise_gnss_position_min, jitter = dot(v, v) * dt * dt / 12.0;
        Row H[3];
        double r[3];
        for (int i = 0; i < 3; ++i) {
            const double sd = i < 2 ? prm.noise_gnss_position : prm.noise_gnss_altitude;
            r[i] = (r_given[i] >= 0.0 ? std::max(r_given[i], floor) : sd * sd) + jitter;
            H[i] = {2, {THETA, POS, 0}, {}};
            lever(C, arm, -1.0, i, H[i].h[0]);
            H[i].h[1][i] = 1.0;
        }
        fuse(1, stamp, 3, H, z, h, r, prm.gate_gnss, prm.timeout_gnss, false, false);
    }

    void barometer(double stamp, const double* measured, const double* r_given) {
        const double z = measured[0] - prm.alt, h = baro - p.z;
        double r = r_given[0] >= 0.0 ? r_given[0] : prm.noise_barometer * prm.noise_barometer;
        const Row H = {2, {POS, BARO - 2, 0}, {{0.0, 0.0, -1.0}, {0.0, 0.0, 1.0}, {}}};
        fuse(2, stamp, 1, &H, &z, &h, &r, prm.gate_barometer, prm.timeout_barometer, false, false);
    }

    // Compass heading with the exact row of the tilt-levelled innovation; the gain keeps only the turn about the vertical.
    void magnetometer(double stamp, const double* measured) {
        const Mat C = dcm(q);
        const Vec m = load(measured), mu = C * m;
        const double horizontal = std::sqrt(mu.x * mu.x + mu.y * mu.y);
        const bool refused = std::fabs(std::sqrt(dot(m, m)) / prm.strength - 1.0) > prm.field_tolerance_strength ||
                             std::fabs(std::atan2(mu.z, horizontal) - prm.dip) > prm.field_tolerance_dip ||
                             horizontal < 0.2 * prm.strength * std::cos(prm.dip);
        const double z = wrap(prm.declination - std::atan2(mu.y, mu.x)), h = 0.0;
        const double sd = prm.noise_magnetometer / std::max(horizontal, 1e-3);
        double r = sd * sd;
        Row H = {1, {THETA, 0, 0}, {}};
        for (int j = 0; j < 3; ++j) H.h[0][j] = C.m[2][j] - tan_dip_n * C.m[0][j] - tan_dip_e * C.m[1][j];
        fuse(3, stamp, 1, &H, &z, &h, &r, prm.gate_magnetometer, prm.timeout_magnetometer, refused, true);
    }

    // One row of the output: t, q, v, p, biases, attitude covariance, other variances, barometer.
    void write(double* rows, int64_t i) const {
        double* o = rows + WIDTH * i;
        auto put = [&o](double x) { *o++ = x; };
        put(t);
        put(q.w), put(q.x), put(q.y), put(q.z);
        for (const Vec& x : {v, p, bg, ba}) put(x.x), put(x.y), put(x.z);
        put(P[0][0]), put(P[0][1]), put(P[0][2]), put(P[1][1]), put(P[1][2]), put(P[2][2]);
        for (int k = VEL; k < BARO; ++k) put(P[k][k]);
        put(baro), put(P[BARO][BARO]);
    }
};

}  // namespace

extern "C" {

int64_t state_size() { return sizeof(State); }

// Run over n IMU samples and m measurements, in the order of their stamps; the first sample only begins the first interval.
void run(State* state, const Parameters* parameters, const double* t, const double* gyro, const double* accel, int64_t n,
         const int64_t* kind, const double* stamp, const double* z, const double* r, int64_t m, double* rows) {
    Filter filter;
    filter.begin(*state, *parameters);
    filter.t = t[0];
    filter.write(rows, 0);
    int64_t j = 0;
    for (int64_t i = 1; i < n; ++i) {
        const double dt = t[i] - t[i - 1];
        filter.t = t[i];
        filter.predict(load(gyro + 3 * (i - 1)), load(accel + 3 * (i - 1)), load(gyro + 3 * i), load(accel + 3 * i), dt);
        for (; j < m && stamp[j] <= t[i]; ++j) {
            const double *zj = z + 3 * j, *rj = r + 3 * j;
            switch (kind[j]) {
                case 0: filter.gnss_velocity(stamp[j], zj, rj); break;
                case 1: filter.gnss_position(stamp[j], zj, rj, dt); break;
                case 2: filter.barometer(stamp[j], zj, rj); break;
                case 3: filter.magnetometer(stamp[j], zj); break;
            }
        }
        filter.write(rows, i);
    }
    filter.end(*state);
}

}  // extern "C"
