/* The table of parameters. The start values are the paper's, times (180/pi)/1000 for kp, ki, kd.
 * Adapt bounds and start values to the aircraft; names and units are the bridge's. */
#include "quad_parameters.h"

#include <string.h>

#define SI (57.29577951308232 / 1000.0) /* us of pulse per deg/s to command per rad/s */

#define AXIS(name, angle_kp, kp, ki, kd)                                                           \
    {name "_ANG_KP", 0.0f, 20.0f, angle_kp}, {name "_ANG_RLIM", 0.1f, 20.0f, 4.0f},                \
        {name "_RATE_KP", 0.0f, 1.0f, (float)((kp) * SI)},                                         \
        {name "_RATE_KI", 0.0f, 1.0f, (float)((ki) * SI)},                                         \
        {name "_RATE_KD", 0.0f, 0.05f, (float)((kd) * SI)},                                        \
        {name "_RATE_DFHZ", 1.0f, 120.0f, 30.0f}, {name "_RATE_ILIM", 0.0f, 1.0f, 0.1f},           \
        {name "_RATE_ULIM", 0.01f, 1.0f, 0.3f}

const quad_parameter quad_parameters[QUAD_PARAMETERS] = {
    AXIS("ROLL", 3.0f, 1.3, 0.01, 0.023),
    AXIS("PITCH", 3.0f, 1.3, 0.01, 0.023),
    AXIS("YAW", 2.0f, 3.0, 0.02, 0.0),
    {"GYRO_FILT_HZ", 5.0f, 200.0f, 42.0f},
    {"ACC_FILT_HZ", 5.0f, 200.0f, 42.0f},
    {"LOOP_RATE_HZ", 1.0f, 0.0f, 250.0f},
};

int quad_parameter_index(const char name[QUAD_NAME_LENGTH])
{
    for (int i = 0; i < QUAD_PARAMETERS; i++) {
        if (strncmp(name, quad_parameters[i].name, QUAD_NAME_LENGTH) == 0) {
            return i;
        }
    }
    return -1;
}

bool quad_parameter_fits(size_t index, float value)
{
    /* false for NaN as well */
    return value >= quad_parameters[index].lowest && value <= quad_parameters[index].highest;
}
