/* The chips' drivers on a bus in memory: conversions against the datasheets' examples, the receiver's pulses,
 * and how long the bus is busy in a cycle. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "check.h"
#include "esc.h"
#include "hmc5883.h"
#include "mpu6050.h"
#include "ms5611.h"
#include "radio.h"

#define PI 3.141592653589793
#define BYTE_US 22.5 /* nine bits at 400 kHz */

static bool near(double a, double b, double within)
{
    return fabs(a - b) <= within;
}

/* A bus on which each chip has 256 registers; a FIFO and conversions are scripted by the tests. */
static uint8_t mpu[256], hmc[256];
static uint16_t prom[8] = {7, 40127, 36924, 23317, 23282, 33464, 28312, 0};
static uint32_t adc[2] = {9085466, 8569150}; /* pressure, temperature */
static uint8_t fifo[1024], converting;
static size_t fifo_count, bus_bytes;
static bool silent;

static bool bus_write(uint8_t device, const uint8_t *bytes, size_t count)
{
    bus_bytes += 1 + count;
    if (device == 0x77) {
        converting = bytes[0];
    }
    for (size_t i = 1; i < count; i++) {
        if (device == 0x68) {
            mpu[(bytes[0] + i - 1) % 256] = bytes[i];
        } else {
            hmc[(bytes[0] + i - 1) % 256] = bytes[i];
        }
    }
    if (device == 0x68 && bytes[0] == 0x6A && (bytes[1] & 4) != 0) {
        fifo_count = 0;
    }
    return !silent;
}

static bool bus_read(uint8_t device, uint8_t reg, uint8_t *bytes, size_t count)
{
    bus_bytes += 3 + count;
    if (device == 0x77) {
        const uint32_t value = reg == 0 ? adc[converting == 0x58] : prom[(reg - 0xA0) / 2];
        for (size_t i = 0; i < count; i++) {
            bytes[i] = (uint8_t)(value >> (8 * (count - 1 - i)));
        }
    } else if (device == 0x68 && reg == 0x72) {
        bytes[0] = (uint8_t)(fifo_count >> 8);
        bytes[1] = (uint8_t)fifo_count;
    } else if (device == 0x68 && reg == 0x74) {
        memcpy(bytes, fifo, count);
        fifo_count -= count;
        memmove(fifo, &fifo[count], fifo_count);
    } else {
        memcpy(bytes, &(device == 0x68 ? mpu : hmc)[reg], count);
    }
    return !silent;
}

static const quad_bus bus = {bus_write, bus_read};

static void put_word(uint8_t *bytes, int value)
{
    bytes[0] = (uint8_t)((unsigned)value >> 8);
    bytes[1] = (uint8_t)value;
}

static void fill_fifo(size_t samples)
{
    static const int words[6] = {4096, -4096, 32767, 655, -655, -32768};
    fifo_count = 12 * samples;
    for (size_t i = 0; i < 6 * samples; i++) {
        put_word(&fifo[2 * i], words[i % 6] + (i >= 6 && i % 6 == 0 ? 1 : 0));
    }
}

static void test_gyro(void)
{
    quad_sensors s;
    check(!mpu6050_start(&bus), "another chip is no MPU-6050");
    mpu[0x75] = 0x68;
    check(mpu6050_start(&bus), "the MPU-6050 starts");
    check(mpu[0x6B] == 1 && mpu[0x19] == 7 && mpu[0x1B] == 8 && mpu[0x1C] == 16 &&
              mpu[0x23] == 0x78 && mpu[0x6A] == 0x40 && mpu[0x37] == 2, "its registers");
    check(mpu6050_read(&bus, &s) && s.samples == 0, "an empty FIFO");
    fill_fifo(4);
    check(mpu6050_read(&bus, &s) && s.samples == 4 && fifo_count == 0, "four samples");
    check(near(s.accel[0][0], 9.80665, 1e-5) && near(s.accel[0][1], -9.80665, 1e-5) &&
              near(s.accel[1][0], 9.80665 * 4097 / 4096, 1e-5), "g");
    check(near(s.gyro[0][0], 10 * PI / 180, 1e-6) && near(s.gyro[0][1], -10 * PI / 180, 1e-6) &&
              near(s.gyro[3][2], -32768 / 65.5 * PI / 180, 1e-5), "deg/s");
    fill_fifo(QUAD_MOST_SAMPLES);
    check(mpu6050_read(&bus, &s) && s.samples == QUAD_MOST_SAMPLES, "as many as fit");
    fill_fifo(QUAD_MOST_SAMPLES + 1);
    check(!mpu6050_read(&bus, &s) && s.samples == 0 && fifo_count == 0, "too many: emptied");
    fill_fifo(1);
    fifo_count += 5; /* half a record stays for the next time */
    check(mpu6050_read(&bus, &s) && s.samples == 1 && fifo_count == 5, "half a record waits");
    silent = true;
    check(!mpu6050_read(&bus, &s) && s.samples == 0 && !mpu6050_start(&bus), "no answer");
    silent = false;
}

static void test_compass(void)
{
    float gauss[3];
    check(!hmc5883_start(&bus), "another chip is no HMC5883");
    memcpy(&hmc[10], "H43", 3);
    check(hmc5883_start(&bus) && hmc[0] == 0x78 && hmc[1] == 0x20 && hmc[2] == 0, "HMC5883");
    put_word(&hmc[3], 1090);
    put_word(&hmc[5], -545);
    put_word(&hmc[7], 218);
    hmc5883_read(&bus, gauss);
    check(near(gauss[0], 1, 1e-6) && near(gauss[1], 0.2, 1e-6) && near(gauss[2], -0.5, 1e-6),
          "x, y, z though its registers are x, z, y");
    put_word(&hmc[5], -4096);
    hmc5883_read(&bus, gauss);
    check(gauss[0] == 1.0f && isnan(gauss[2]), "an axis beyond its range");
    silent = true;
    hmc5883_read(&bus, gauss);
    check(isnan(gauss[0]) && isnan(gauss[1]) && isnan(gauss[2]) && !hmc5883_start(&bus), "silent");
    silent = false;
}

/* Page 9 of the datasheet in real numbers. */
static void compensated(double d1, double d2, double *hpa, double *celsius)
{
    const double dt = d2 - prom[5] * 256.0, temp = 2000 + dt * prom[6] / 8388608.0;
    double off = prom[2] * 65536.0 + prom[4] * dt / 128, sens = prom[1] * 32768.0 + prom[3] * dt / 256;
    double t2 = 0;
    if (temp < 2000) {
        t2 = dt * dt / 2147483648.0;
        off -= 2.5 * (temp - 2000) * (temp - 2000) + (temp < -1500 ? 7 * pow(temp + 1500, 2) : 0);
        sens -= 1.25 * (temp - 2000) * (temp - 2000) + (temp < -1500 ? 5.5 * pow(temp + 1500, 2) : 0);
    }
    *hpa = (d1 * sens / 2097152 - off) / 32768 / 100;
    *celsius = (temp - t2) / 100;
}

static void test_barometer(void)
{
    static const uint16_t note[8] = {0x3132, 0x3334, 0x3536, 0x3738, 0x3940, 0x4142, 0x4344, 0x4500};
    ms5611 chip;
    float hpa, celsius;
    double real_hpa, real_celsius;
    ms5611_compensate(prom, 9085466, 8569150, &hpa, &celsius);
    check(near(hpa, 1000.09, 1e-3) && near(celsius, 20.07, 1e-4), "the datasheet's example");
    for (uint32_t raw = 6000000; raw < 9500000; raw += 12345) { /* -71 to 51 deg C */
        ms5611_compensate(prom, 9085466, raw, &hpa, &celsius);
        compensated(9085466, raw, &real_hpa, &real_celsius);
        check(near(hpa, real_hpa, 0.06) && near(celsius, real_celsius, 0.03), "its equations, rounded");
    }
    check(ms5611_crc(note) == 0xB, "AN520's example");
    check(!ms5611_start(&chip, &bus) && converting == 0x1E, "a wrong checksum: it is reset");
    prom[7] = ms5611_crc(prom);
    check(ms5611_start(&chip, &bus), "the MS5611 starts");
    uint64_t first_us = 0;
    for (uint64_t now_us = 0; now_us < 60000 && first_us == 0; now_us += 4000) {
        ms5611_cycle(&chip, &bus, now_us, &hpa, &celsius);
        first_us = isnan(hpa) ? 0 : now_us;
    }
    check(near(hpa, 1000.09, 1e-3) && first_us == 24000, "both after two conversions of 12 ms");
    adc[0] = 0; /* as a chip says that has not converted */
    for (uint64_t now_us = 28000; now_us < 60000; now_us += 4000) {
        ms5611_cycle(&chip, &bus, now_us, &hpa, &celsius);
    }
    check(isnan(hpa) && isnan(celsius), "no conversion, no pressure");
    adc[0] = 9085466;
}

/* A cycle's readings, and the board's calls in the same order: they must leave half of it. */
static void test_bus_time(void)
{
    ms5611 chip;
    quad_sensors s;
    float gauss[3], hpa, celsius;
    double longest_us = 0;
    ms5611_start(&chip, &bus);
    for (uint64_t cycle = 0; cycle < 50; cycle++) {
        bus_bytes = 0;
        fill_fifo(4 + cycle % 2); /* its clock and ours differ by some per cent */
        mpu6050_read(&bus, &s);
        hmc5883_read(&bus, gauss);
        ms5611_cycle(&chip, &bus, 4000 * cycle, &hpa, &celsius);
        longest_us = fmax(longest_us, BYTE_US * (double)bus_bytes);
    }
    check(longest_us < 2000, "the bus leaves half of a cycle");
    printf("bus %.0f us in a cycle\n", longest_us);
}

static radio r;
static uint32_t clock_us;

static void edges(void)
{
    const radio_edge up = {(uint16_t)clock_us, 0, true}, down = {(uint16_t)(clock_us + 300), 0, false};
    radio_take(&r, up, clock_us);
    radio_take(&r, down, clock_us + 300);
}

static void pulses(const uint16_t *widths, size_t count, uint32_t gap_us)
{
    for (size_t i = 0; i <= count; i++) {
        edges();
        clock_us += i < count ? widths[i] : gap_us;
    }
}

static bool alike(const uint16_t *widths, size_t count)
{
    bool is = !radio_now(&r, clock_us).failsafe;
    for (size_t i = 0; i < count; i++) {
        is = is && radio_now(&r, clock_us).pulse_us[i] == (float)widths[i];
    }
    return is;
}

static void test_ppm(void)
{
    static const uint16_t frame[9] = {1500, 1400, 1000, 1600, 1000, 2000, 1000, 1000, 1234};
    static const uint16_t noisy[9] = {1501, 1400, 300, 700, 1600, 1000, 2000, 1000, 1000};
    radio_start(&r, true);
    clock_us = 60000; /* its 16 bits wrap in the second frame */
    check(radio_now(&r, clock_us).failsafe, "failsafe before the first frame");
    pulses(&frame[4], 5, 6000); /* the end of a frame: no gap was seen before */
    check(radio_now(&r, clock_us).failsafe, "half a frame is none");
    pulses(frame, 9, 6000);
    pulses(frame, 9, 6000);
    check(radio_now(&r, clock_us).failsafe, "one frame alone says not how many channels there are");
    pulses(frame, 9, 6000);
    check(alike(frame, 9), "nine channels of PPM");
    pulses(noisy, 9, 6000);
    pulses(frame, 4, 6000); /* a frame that was cut */
    check(radio_now(&r, clock_us).pulse_us[0] == 1500.0f, "a frame with noise is not used");
    pulses(frame, 9, 6000);
    pulses(frame, 9, 6000);
    check(alike(frame, 9), "the next good one is");
    clock_us += 200000;
    for (size_t i = 0; i < 12; i++) { /* the first edge ends the frame of before */
        pulses(frame, 8, 6000);
    }
    check(alike(frame, 8), "after silence eight channels do");
    check(!radio_now(&r, clock_us + 50000).failsafe, "two frames may be lost");
    check(radio_now(&r, clock_us + 130000).failsafe, "silence is failsafe");
}

/* An edge that is lost, or a spike, shifts all channels behind it: such a frame is not used, wherever it is. */
static void test_ppm_edges(void)
{
    static const uint16_t frame[12] = {1700, 1400, 1900, 1600, 1000, 2000, 1100, 1200, 1234, 1500, 1300, 1000};
    for (size_t count = 6; count <= 12; count++) {
        for (size_t at = 0; at < 2 * count + 1; at++) {
            radio_start(&r, true);
            for (size_t i = 0; i < 4; i++) {
                pulses(frame, count, 6000);
            }
            for (size_t i = 0; i <= count; i++) {
                const uint32_t width_us = i < count ? frame[i] : 6000;
                if (at != i) {
                    edges();
                }
                if (at == count + 1 + i) {
                    clock_us += width_us / 2;
                    edges();
                    clock_us -= width_us / 2;
                }
                clock_us += width_us;
            }
            pulses(frame, count, 6000);
            check(alike(frame, count < 9 ? count : 9), "an edge too few or too many");
        }
    }
}

static void test_pwm(void)
{
    radio_start(&r, false);
    for (uint8_t wire = 0; wire < 6; wire++) {
        const uint16_t rose = (uint16_t)(65000 + wire), width = (uint16_t)(1100 + 100 * wire);
        const radio_edge up = {rose, wire, true}, down = {(uint16_t)(rose + width), wire, false};
        check(radio_now(&r, 1000).failsafe == (wire < 4), "failsafe until four wires speak");
        radio_take(&r, up, 1000);
        radio_take(&r, down, 1000);
    }
    check(radio_now(&r, 2000).pulse_us[5] == 1600.0f && radio_now(&r, 2000).pulse_us[6] == 0.0f, "PWM");
    const radio_edge glitch = {100, 2, true}, end = {150, 2, false}, nobodys = {0, 200, true};
    radio_take(&r, glitch, 2000);
    radio_take(&r, end, 2000);
    radio_take(&r, nobodys, 2000);
    check(radio_now(&r, 2000).pulse_us[2] == 1300.0f, "a glitch is no pulse");
    const radio_edge rise = {20000, 3, true}, fall = {21000, 3, false}, spike = {21800, 3, false};
    radio_take(&r, rise, 3000);
    radio_take(&r, fall, 3000);
    radio_take(&r, spike, 3000); /* so short that its rise was not seen */
    check(radio_now(&r, 3000).pulse_us[3] == 1000.0f, "a pulse ends once");
    check(radio_now(&r, 1000 + RADIO_LOST_US + 2).failsafe, "a wire fell silent");
    for (uint8_t wire = 0; wire < 5; wire++) { /* all but the arming switch's */
        const radio_edge up = {0, wire, true}, down = {1500, wire, false};
        radio_take(&r, up, 1000 + RADIO_LOST_US);
        radio_take(&r, down, 1000 + RADIO_LOST_US);
    }
    check(radio_now(&r, 1000 + RADIO_LOST_US + 2).failsafe, "a switch's wire fell silent");
    check(!radio_now(&r, 1000 + RADIO_LOST_US).failsafe, "it was heard until then");
}

/* What comes from the radio goes through the firmware: kill, arming, the switch that must be seen off. */
static void test_arming(void)
{
    static quad_firmware f;
    const quad_firmware_settings settings = quad_firmware_defaults();
    quad_inputs in;
    float motors[4];
    memset(&in, 0, sizeof in);
    in.sensors.slow.battery_v = 12.0f / 11.0f;
    in.sensors.samples = 1;
    in.sensors.accel[0][2] = 9.81f;
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        in.receiver.pulse_us[i] = i == 2 || i > 3 ? 1000.0f : 1500.0f;
    }
    quad_firmware_init(&f, &settings);
    for (uint64_t cycle = 0; cycle < 10; cycle++) { /* with a wire each, a switch that is on may be heard last */
        in.receiver.pulse_us[5] = cycle < 5 ? 0.0f : 2000.0f;
        quad_firmware_cycle(&f, 4000 * cycle, &in, motors);
        check(!f.endpoint.armed, "a switch that was not heard was not seen off");
    }
    quad_firmware_init(&f, &settings);
    in.receiver.pulse_us[5] = 2000.0f;
    for (uint64_t cycle = 0; cycle < 130; cycle++) {
        in.receiver.pulse_us[5] = cycle < 10 || (cycle >= 30 && cycle < 120) ? 2000.0f : 1000.0f;
        in.sensors.samples = cycle < 90 ? 1 : 0;
        quad_firmware_cycle(&f, 4000 * cycle, &in, motors);
        const bool turns = (f.record.flags & QUAD_FLAG_ARMED) != 0;
        check(turns == (cycle > 40 && cycle < 116), "armed by the switch that was off, off without gyro");
    }
    in.receiver.pulse_us[5] = 2000.0f;
    for (uint64_t cycle = 130; cycle < 150; cycle++) {
        quad_firmware_cycle(&f, 4000 * cycle, &in, motors);
        check(!f.endpoint.armed && motors[0] == 0.0f, "nothing arms without a gyro");
    }
    in.sensors.samples = 1;
    for (uint64_t cycle = 150; cycle < 400; cycle++) {
        in.receiver.pulse_us[2] = cycle > 220 && cycle < 250 ? 1600.0f : 1000.0f;
        in.receiver.pulse_us[4] = cycle > 230 && cycle < 240 ? 2000.0f : 1000.0f;
        in.receiver.pulse_us[5] = (cycle > 170 && cycle < 190) || (cycle > 300 && cycle < 320) ? 1000.0f : 2000.0f;
        quad_firmware_cycle(&f, 4000 * cycle, &in, motors);
        const bool turns = (f.record.flags & QUAD_FLAG_ARMED) != 0;
        check(turns == ((cycle > 200 && cycle <= 230) || cycle > 330), "killed: until it is armed again");
    }
}

/* One frame that was heard wrong, on a wire with a spike or in bits without a checksum, is no pilot's will: it neither
 * disarms, nor arms what stands, nor arms what was killed a second time. */
static void test_switch_heard_wrong(void)
{
    static quad_firmware f;
    const quad_firmware_settings settings = quad_firmware_defaults();
    quad_inputs in = {.sensors = {.samples = 1, .accel = {{0.0f, 0.0f, 9.81f}}}};
    float motors[4];
    in.sensors.slow.battery_v = 12.0f / 11.0f;
    for (size_t i = 0; i < QUAD_CHANNELS; i++) {
        in.receiver.pulse_us[i] = i == 2 || i > 3 ? 1000.0f : 1500.0f;
    }
    quad_firmware_init(&f, &settings);
    for (uint64_t cycle = 0; cycle < 400; cycle++) {
        const bool wrong = cycle % 50 >= 45, on = (cycle >= 100 && cycle < 200) || cycle >= 300;
        in.receiver.pulse_us[2] = cycle > 120 && cycle < 200 ? 1500.0f : 1000.0f;
        in.receiver.pulse_us[4] = cycle >= 325 && cycle < 330 ? 2000.0f : 1000.0f;
        in.receiver.pulse_us[5] = on != wrong ? 2000.0f : 1000.0f;
        quad_firmware_cycle(&f, 4000 * cycle, &in, motors);
        const bool turns = (f.record.flags & QUAD_FLAG_ARMED) != 0;
        const bool may = (cycle >= 100 && cycle < 225) || (cycle >= 300 && cycle < 325);
        const bool must = (cycle >= 125 && cycle < 200) || cycle == 324;
        check((may || !turns) && (turns || !must), "armed from switched on to switched off");
    }
}

/* Whether it has said so since it was asked last. */
static bool said(quad_firmware *f, const char *text)
{
    static uint8_t bytes[QUAD_OUTBOX];
    const size_t count = quad_firmware_send(f, bytes, sizeof bytes), length = strlen(text);
    for (size_t i = 0; i + length <= count; i++) {
        if (memcmp(&bytes[i], text, length) == 0) {
            return true;
        }
    }
    return false;
}

/* What it does not arm for is said; and it does not arm because the transmitter was switched on. */
static void test_not_armed(void)
{
    static const char *const why[] = {"not armed: throttle above 5 %", "not armed: kill switch", "not armed: low battery",
                                      "not armed: the gyro", "not armed: tilted"};
    static quad_firmware f;
    quad_firmware_settings settings = quad_firmware_defaults();
    float motors[4];
    for (int k = 0; k < 8; k++) {
        quad_inputs in = {.sensors = {.samples = k == 3 ? 0 : 1, .accel = {{0.0f, 0.0f, 9.81f}}}};
        in.sensors.accel[0][1] = k == 4 ? 9.81f : 0.0f;
        in.sensors.slow.battery_v = (k == 2 ? 9.0f : 12.0f) / 11.0f;
        settings.endpoint.unreadable = k == 7;
        quad_firmware_init(&f, &settings);
        check(k != 7 || !said(&f, "set-up"), "it has said nothing yet");
        for (uint64_t cycle = 0; cycle < 60; cycle++) {
            for (size_t i = 0; i < QUAD_CHANNELS; i++) {
                const bool on = (i == 4 && k == 1) || (i == 5 && cycle >= 40);
                in.receiver.pulse_us[i] = i < 4 && i != 2 ? 1500.0f : on ? 2000.0f : 1000.0f;
            }
            in.receiver.pulse_us[2] = k == 0 ? 1100.0f : 1000.0f;
            in.receiver.failsafe = k == 6 && cycle > 20 && cycle < 50;
            check(cycle != 40 || !said(&f, "not armed"), "nobody wants to arm it yet");
            quad_firmware_cycle(&f, 4000 * cycle, &in, motors);
        }
        check(f.endpoint.armed == (k == 5), "armed where nothing forbids it");
        check(k > 4 || said(&f, why[k]), "and what does is said");
        check(k != 7 || said(&f, "set-up: the stored one cannot be read"), "a set-up that was lost, too");
    }
    f.endpoint.gains.confirmations = 1;
    quad_inputs in = {.sensors = {.samples = 1, .accel = {{0.0f, 0.0f, 9.81f}}, .slow = {.battery_v = 12.0f / 11.0f}}};
    for (uint64_t cycle = 60; cycle < 100; cycle++) {
        for (size_t i = 0; i < QUAD_CHANNELS; i++) {
            in.receiver.pulse_us[i] = i < 4 && i != 2 ? 1500.0f : i == 5 && cycle >= 80 ? 2000.0f : 1000.0f;
        }
        quad_firmware_cycle(&f, 4000 * cycle, &in, motors);
    }
    check(f.endpoint.armed, "until there is another one");
    float lost[QUAD_PARAMETERS];
    memcpy(lost, f.endpoint.gains.good, sizeof lost);
    check(quad_gains_init(&f.endpoint.gains, lost), "its own values fit");
    lost[QUAD_PARAMETERS - 1] = NAN;
    check(!quad_gains_init(&f.endpoint.gains, lost), "one that does not fit is told of");
}

int main(void)
{
    test_gyro();
    test_compass();
    test_barometer();
    test_bus_time();
    test_ppm();
    test_ppm_edges();
    test_pwm();
    test_arming();
    test_switch_heard_wrong();
    test_not_armed();
    float motors[4], given[4];
    const float none[4] = {0.5f, NAN, 0.0f, 0.0f};
    check(quad_mix(none, 0.05f, motors, given) && motors[0] == 0.0f && motors[1] == 0.0f, "no number, no thrust");
    check(esc_pulse_us(0, 1000, 2000) == 1000 && esc_pulse_us(1, 1000, 2000) == 2000, "ESC");
    check(esc_pulse_us(0.5f, 1000, 1900) == 1450 && esc_pulse_us(-1, 1100, 1900) == 1100, "its own range");
    check(esc_pulse_us(NAN, 1000, 2000) == 1000 && esc_pulse_us(9, 1000, 2000) == 2000, "limits");
    return checked();
}
