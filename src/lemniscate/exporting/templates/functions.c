// abs
static float policy_abs(float x)
{
    return x < 0.0F ? -x : x;
}

// max
static float policy_max(float a, float b)
{
    return a > b ? a : b;
}

// min
static float policy_min(float a, float b)
{
    return a < b ? a : b;
}

// floor
static float policy_floor(float x)
{
    float whole;
    if (!(x > -8388608.0F && x < 8388608.0F)) {
        return x; /* it has no fraction */
    }
    whole = (float)(int32_t)x;
    return whole > x ? whole - 1.0F : whole;
}

// exp
/* e^x with a relative error below 4e-7 for -87 < x < 88; 0 below, e^88 above. */
static float policy_exp(float x)
{
    float y, power, n;
    uint32_t bits;
    if (x < -87.0F) {
        return 0.0F;
    }
    if (x > 88.0F) {
        x = 88.0F;
    }
    n = (float)(int32_t)(x * 1.442695041F + (x < 0.0F ? -0.5F : 0.5F));
    x = (x - n * 0.693359375F) + n * 2.12194440e-4F; /* e^x = 2^n e^r, |r| <= ln 2 / 2 */
    y = 8.3333333e-3F + x * (1.3888889e-3F + x * 1.9841270e-4F);
    y = 1.0F + x * (1.0F + x * (0.5F + x * (0.16666667F + x * (4.1666667e-2F + x * y))));
    bits = (uint32_t)((int32_t)n + 127) << 23;
    memcpy(&power, &bits, sizeof power);
    return y * power;
}

// sigmoid
/* 1 / (1 + e^-x), with an error below 2e-7. */
static float policy_sigmoid(float x)
{
    return 1.0F / (1.0F + policy_exp(-x));
}

// tanh
/* 2 sigmoid(2x) - 1, with an error below 3e-7. */
static float policy_tanh(float x)
{
    return 2.0F * policy_sigmoid(2.0F * x) - 1.0F;
}

// log
/* The natural logarithm, with an error below 2e-7 + 2e-7 |log x|; that of 2^-126 for what is smaller. */
static float policy_log(float x)
{
    uint32_t bits;
    int32_t exponent;
    float s, s2;
    if (!(x > 1.17549435e-38F)) {
        x = 1.17549435e-38F;
    }
    memcpy(&bits, &x, sizeof bits);
    exponent = (int32_t)(bits >> 23) - 127;
    bits = (bits & 0x007FFFFFU) | 0x3F800000U;
    memcpy(&x, &bits, sizeof x);
    if (x > 1.41421356F) {
        x *= 0.5F;
        exponent += 1;
    }
    s = (x - 1.0F) / (x + 1.0F);
    s2 = s * s;
    x = 2.0F * s * (1.0F + s2 * (0.33333333F + s2 * (0.2F + s2 * (0.14285714F + s2 * 0.11111111F))));
    return x + (float)exponent * 0.693147181F;
}

// sqrt
/* The square root with a relative error below 2e-7; 0 for what is below 2^-126. */
static float policy_sqrt(float x)
{
    uint32_t bits;
    float y;
    if (!(x > 1.17549435e-38F)) {
        return 0.0F;
    }
    memcpy(&bits, &x, sizeof bits);
    bits = (bits >> 1) + 0x1FBD1DF5U;
    memcpy(&y, &bits, sizeof y); /* within 4 %, and three steps of Newton's method */
    y = 0.5F * (y + x / y);
    y = 0.5F * (y + x / y);
    return 0.5F * (y + x / y);
}

// sine
/* The sine of x + quarters pi / 2, with an error below 4e-7 for |x| < 1000; 0 from |x| = 1e6 on. */
static float policy_sine(float x, int32_t quarters)
{
    float n, x2, y;
    if (!(x > -1.0e6F && x < 1.0e6F)) {
        return 0.0F;
    }
    n = (float)(int32_t)(x * 0.636619772F + (x < 0.0F ? -0.5F : 0.5F));
    x = ((x - n * 1.5703125F) - n * 4.837512969970703e-4F) - n * 7.549789948768648e-8F;
    quarters += (int32_t)n;
    x2 = x * x;
    if (quarters & 1) {
        y = 4.1666667e-2F + x2 * (-1.3888889e-3F + x2 * 2.4801587e-5F);
        y = 1.0F + x2 * (-0.5F + x2 * y);
    } else {
        y = 8.3333333e-3F + x2 * (-1.9841270e-4F + x2 * 2.7557319e-6F);
        y = x + x * x2 * (-0.16666667F + x2 * y);
    }
    return quarters & 2 ? -y : y;
}

// sin
static float policy_sin(float x)
{
    return policy_sine(x, 0);
}

// cos
static float policy_cos(float x)
{
    return policy_sine(x, 1);
}

// erf
/* The error function, with an error below 7e-7 (Abramowitz and Stegun 1964, 7.1.26). */
static float policy_erf(float x)
{
    const float t = 1.0F / (1.0F + 0.3275911F * policy_abs(x));
    float y = 0.254829592F + t * (-0.284496736F + t * (1.421413741F + t * (-1.453152027F + t * 1.061405429F)));
    y = 1.0F - t * y * policy_exp(-x * x);
    return x < 0.0F ? -y : y;
}

// roundbfloat16
/* The nearest number with 8 bits of mantissa; of two, the even one. */
static float policy_roundbfloat16(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    bits += 0x7FFFU + ((bits >> 16) & 1U);
    bits &= 0xFFFF0000U;
    memcpy(&x, &bits, sizeof x);
    return x;
}

// linear
/* y[outputs] = weight[outputs][inputs] x[inputs] + bias[outputs]; no bias is 0. Four sums, so that none waits. */
static void policy_linear(const float *weight, const float *bias, const float *x, int inputs, int outputs, float *y)
{
    int row, i;
    for (row = 0; row < outputs; ++row, weight += inputs) {
        float a = bias ? bias[row] : 0.0F, b = 0.0F, c = 0.0F, d = 0.0F;
        for (i = 0; i + 3 < inputs; i += 4) {
            a += weight[i] * x[i];
            b += weight[i + 1] * x[i + 1];
            c += weight[i + 2] * x[i + 2];
            d += weight[i + 3] * x[i + 3];
        }
        for (; i < inputs; ++i) {
            a += weight[i] * x[i];
        }
        y[row] = (a + b) + (c + d);
    }
}

// argmax
/* The index of the largest number; of several, the first. */
static float policy_argmax(const float *x, int size)
{
    int i, best = 0;
    for (i = 1; i < size; ++i) {
        best = x[i] > x[best] ? i : best;
    }
    return (float)best;
}

// reducesum
static float policy_reducesum(const float *x, int size)
{
    float sum = 0.0F;
    int i;
    for (i = 0; i < size; ++i) {
        sum += x[i];
    }
    return sum;
}

// reducemean
static float policy_reducemean(const float *x, int size)
{
    return policy_reducesum(x, size) / (float)size;
}

// reducemax
static float policy_reducemax(const float *x, int size)
{
    float y = x[0];
    int i;
    for (i = 1; i < size; ++i) {
        y = x[i] > y ? x[i] : y;
    }
    return y;
}

// reducemin
static float policy_reducemin(const float *x, int size)
{
    float y = x[0];
    int i;
    for (i = 1; i < size; ++i) {
        y = x[i] < y ? x[i] : y;
    }
    return y;
}
