/* The parameters of quad_parameter_table.h. */
#include "quad_parameters.h"

#include <string.h>

const quad_parameter quad_parameters[QUAD_PARAMETERS] = {QUAD_PARAMETER_TABLE};

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
