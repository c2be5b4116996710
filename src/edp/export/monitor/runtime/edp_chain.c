/* Arithmetic and detectors of exported monitors; see edp_chain.h. */
#include "edp_chain.h"

#include <stddef.h>
#include <string.h>

#define EXPONENT 0x7FF0000000000000u
#define MANTISSA 0x000FFFFFFFFFFFFFu
#define HIDDEN 0x0010000000000000u

static uint64_t bits_of(double x) {
    uint64_t bits;
    (void)memcpy(&bits, &x, sizeof bits);
    return bits;
}

static double from_bits(uint64_t bits) {
    double x;
    (void)memcpy(&x, &bits, sizeof x);
    return x;
}

bool edp_known(double x) { return (bits_of(x) & EXPONENT) != EXPONENT; }

double edp_unknown(void) { return from_bits(EXPONENT | (HIDDEN >> 1)); }

double edp_root(double x) {
    double result = x; /* zero with its sign, NaN and +infinity are their own roots */
    if (x < 0.0) {
        result = edp_unknown();
    } else if ((x > 0.0) && edp_known(x)) {
        /* 2^54 brings what is subnormal into the normal range, without rounding. */
        const bool tiny = bits_of(x) < HIDDEN;
        const uint64_t bits = bits_of(tiny ? (x * 18014398509481984.0) : x);
        const int32_t power = (int32_t)(bits >> 52) - 1023;
        uint64_t left = (bits & MANTISSA) | HIDDEN;
        uint64_t root = 0u;
        uint64_t twice = 0u;
        int32_t half = power / 2;
        if ((power % 2) != 0) { /* an even power of two is left outside */
            left <<= 1;
            half -= (power < 0) ? 1 : 0;
        }
        /* Digit by digit: 53 bits of the root, and one to round by. */
        left <<= 1;
        for (uint64_t digit = HIDDEN << 1; digit != 0u; digit >>= 1) {
            const uint64_t next = twice + digit;
            if (next <= left) {
                twice = next + digit;
                left -= next;
                root += digit;
            }
            left <<= 1;
        }
        /* A root is never halfway between two numbers. */
        root += root & 1u;
        result = from_bits((root >> 1) + ((uint64_t)(int64_t)(half + 1022) << 52));
        result = tiny ? (result * 7.450580596923828125e-9) : result; /* 2^-27 */
    }
    return result;
}

double edp_dot(const double *x, const double *y, uint32_t n, uint32_t stride) {
    double sum = 0.0;
    for (uint32_t i = 0; i < n; i++) {
        sum += x[i] * y[(size_t)i * stride];
    }
    return sum;
}

void edp_clear(uint32_t n, double *values) {
    for (uint32_t i = 0; i < n; i++) {
        values[i] = 0.0;
    }
}

double edp_cusum(double slack, const double *row, uint32_t n, double *sums) {
    double length;
    double left;
    double share;
    for (uint32_t i = 0; i < n; i++) {
        sums[i] += row[i];
    }
    length = edp_root(edp_dot(sums, sums, n, 1u));
    left = ((length - slack) > 0.0) ? (length - slack) : 0.0;
    share = left / ((length > 1e-300) ? length : 1e-300);
    for (uint32_t i = 0; i < n; i++) {
        sums[i] *= share;
    }
    return left;
}

double edp_ewma(double weight, double factor, const double *row, uint32_t n, double *means) {
    for (uint32_t i = 0; i < n; i++) {
        means[i] += weight * (row[i] - means[i]);
    }
    return edp_dot(means, means, n, 1u) * factor;
}

double edp_glr_ratio(const double *row, uint32_t n, const double *before, uint32_t length, double *sums) {
    for (uint32_t i = 0; i < n; i++) {
        sums[i] = ((before == NULL) ? 0.0 : before[i]) + row[i];
    }
    return edp_dot(sums, sums, n, 1u) / (2.0 * (double)length);
}
