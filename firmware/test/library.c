/* The endpoint as a shared library for the tests, which load it into Python. One endpoint. */
#include <string.h>

#include "quad_endpoint.h"

void lib_init(int armed, int may_arm, const uint8_t *key, uint64_t signing_time);
void lib_receive(const uint8_t *bytes, size_t count, uint64_t now_us);
void lib_cycle(uint64_t now_us, int kill, int failsafe, float battery_v, unsigned flags);
size_t lib_send(uint8_t *out, size_t room);
float lib_in_force(size_t index);
void lib_counts(uint32_t out[6]);
int lib_parameter(size_t index, char name[17], float bounds[3]);
size_t lib_size(void);

static quad_endpoint endpoint;

void lib_init(int armed, int may_arm, const uint8_t *key, uint64_t signing_time)
{
    const quad_settings settings = {.system = 1,
                                    .component = 1,
                                    .aircraft = 7,
                                    .rate_hz = 250,
                                    .low_battery_v = 9.9f,
                                    .armed = armed != 0,
                                    .may_arm = may_arm != 0,
                                    .key = key,
                                    .signing_time = signing_time};
    quad_endpoint_init(&endpoint, &settings);
}

void lib_receive(const uint8_t *bytes, size_t count, uint64_t now_us)
{
    quad_endpoint_receive(&endpoint, bytes, count, now_us);
}

void lib_cycle(uint64_t now_us, int kill, int failsafe, float battery_v, unsigned flags)
{
    const quad_pilot pilot = {{1500, 1500, 1500, 1500}, 4, failsafe != 0, kill != 0};
    const quad_slow slow = {battery_v, {0.25f, -0.5f, 0.125f}, 1013.25f, 21.5f};
    quad_cycle record;
    quad_endpoint_begin_cycle(&endpoint, now_us, &pilot, &record);
    record.flags = (uint16_t)(record.flags | flags);
    quad_endpoint_end_cycle(&endpoint, &record, &pilot, &slow);
}

size_t lib_send(uint8_t *out, size_t room)
{
    return quad_endpoint_send(&endpoint, out, room);
}

float lib_in_force(size_t index)
{
    return endpoint.in_force[index];
}

void lib_counts(uint32_t out[6])
{
    const quad_counts *c = &endpoint.counts;
    const uint32_t all[6] = {c->frames, c->bad, c->unsigned_frames, c->forged, c->replayed,
                             c->dropped};
    memcpy(out, all, sizeof all);
}

int lib_parameter(size_t index, char name[17], float bounds[3])
{
    if (index >= QUAD_PARAMETERS) {
        return 0;
    }
    const quad_parameter *p = &quad_parameters[index];
    memcpy(name, p->name, sizeof p->name);
    bounds[0] = p->lowest;
    bounds[1] = p->highest;
    bounds[2] = p->start;
    return 1;
}

size_t lib_size(void)
{
    return sizeof endpoint;
}
