/* Inside the endpoint: what it sends, a frame each, into the outbox. Not for the control loop. */
#ifndef QUAD_OUTBOX_H
#define QUAD_OUTBOX_H

#include "quad_endpoint.h"

void quad_put_cycle(quad_endpoint *e, const quad_cycle *record);
void quad_put_heartbeat(quad_endpoint *e);
void quad_put_gains_state(quad_endpoint *e, uint8_t action, uint8_t result);
void quad_put_parameter(quad_endpoint *e, size_t index);
void quad_put_time(quad_endpoint *e, uint64_t now_us, int64_t asked_ns);
void quad_put_ack(quad_endpoint *e, uint16_t command, uint8_t result);
void quad_put_text(quad_endpoint *e, uint8_t severity, const char *text); /* up to 50 characters */
/* "timing: latest <us>, longest <us>, stack <bytes>" */
void quad_put_timing(quad_endpoint *e, uint32_t latest_us, uint32_t longest_us, uint32_t stack);
void quad_put_battery(quad_endpoint *e, const quad_slow *slow);
void quad_put_receiver(quad_endpoint *e, const quad_cycle *record, const quad_pilot *pilot);
void quad_put_slow_sensors(quad_endpoint *e, const quad_cycle *record, const quad_slow *slow);

#endif
