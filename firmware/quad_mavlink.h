/* The generated MAVLink headers, and nothing else of ours: `make headers` makes them from
 * quad_suite.xml. They are included as system headers, so that their warnings are not ours. */
#ifndef QUAD_MAVLINK_H
#define QUAD_MAVLINK_H

#define MAVLINK_MAX_SIGNING_STREAMS 4 /* who may command: one bridge, and a few to spare */

#include <quad_suite/mavlink.h>

#endif
