/* The firmware's parameters: names, bounds and first values, in the order of their index. SI.
 * What becomes of them at run time stands in quad_gains.h. */
#ifndef QUAD_PARAMETERS_H
#define QUAD_PARAMETERS_H

#include <stdbool.h>
#include <stddef.h>

#include "quad_parameter_table.h"

#define QUAD_NAME_LENGTH 16 /* on the wire; no NUL behind a name that fills it */

typedef struct {
    char name[QUAD_NAME_LENGTH + 1];
    float lowest, highest; /* nothing fits where lowest > highest */
    float start;
} quad_parameter;

extern const quad_parameter quad_parameters[QUAD_PARAMETERS];

/* Index of a name of up to 16 characters, or -1. */
int quad_parameter_index(const char name[QUAD_NAME_LENGTH]);

/* Whether a parameter may have this value: finite and inside its bounds. */
bool quad_parameter_fits(size_t index, float value);

/* The value of an axis (0 roll, 1 pitch, 2 yaw) in a set of QUAD_PARAMETERS values. */
static inline float quad_of_axis(const float *set, size_t axis, size_t which)
{
    return which < QUAD_PER_AXIS
               ? set[axis * QUAD_PER_AXIS + which]
               : set[QUAD_OPTIONAL + axis * (QUAD_OF_AXIS - QUAD_PER_AXIS) + which - QUAD_PER_AXIS];
}

#endif
