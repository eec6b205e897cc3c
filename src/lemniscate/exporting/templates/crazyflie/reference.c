
#define REFERENCE_STEPS $steps
#define REFERENCE_SAMPLES $samples

static const float reference[REFERENCE_STEPS][3] = { /* m, in the world */
$points
};

static const uint32_t ahead[REFERENCE_SAMPLES] = {$offsets}; /* steps */
