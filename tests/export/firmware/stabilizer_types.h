/* A stand-in for the firmware's header: the same names and types, as far as the controller needs them. */
#ifndef STABILIZER_TYPES_H
#define STABILIZER_TYPES_H

#include <stdbool.h>
#include <stdint.h>

typedef uint32_t stabilizerStep_t;

typedef struct {
    uint32_t timestamp;
    float roll, pitch, yaw;
} attitude_t;

typedef struct {
    uint32_t timestamp;
    float x, y, z;
} point_t;

typedef struct {
    uint32_t timestamp;
    float x, y, z, w;
} quaternion_t;

typedef struct {
    float x, y, z;
} Axis3f;

typedef struct {
    Axis3f acc, gyro;
} sensorData_t;

typedef struct {
    attitude_t attitude;
    quaternion_t attitudeQuaternion;
    point_t position, velocity, acc;
} state_t;

typedef struct {
    int16_t roll, pitch, yaw;
    float thrust;
} control_t;

typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;

typedef struct {
    uint32_t timestamp;
    attitude_t attitude, attitudeRate;
    quaternion_t attitudeQuaternion;
    float thrust;
    point_t position, velocity, acceleration;
    bool velocity_body;
    struct {
        stab_mode_t x, y, z, roll, pitch, yaw, quat;
    } mode;
} setpoint_t;

#define RATE_MAIN_LOOP 1000
#define RATE_DO_EXECUTE(RATE_HZ, TICK) ((TICK % (RATE_MAIN_LOOP / RATE_HZ)) == 0)

#endif
