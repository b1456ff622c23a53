/*
 * A toy that feels: @title@, @layout@, @n_channels@ channels, @n_classes@ gestures.
 *
 * Every @period@ ms it reads its sensors, gives the readings to the library, shows with its eyes and its voice what it
 * felt, and sends the readings on as a line, so that `plushsense record` and `plushsense live` work with this toy too.
 *
 * In order: settings - sensors - eyes and voice - lines - setup() and loop().
 */
#include <Wire.h>
#include <plush_model.h>
#include <plush_wire.h>
#include <plushsense.h>

#include "plush_fake.h"
#include "plush_reaction.h"

#if defined(__AVR__)
#error "This model needs a board with 32 bits: an ESP32, RP2040, nRF52, SAMD or STM32."
#endif

/* ---- Settings: yours to change --------------------------------------------------------------------------------- */

#define SENSORS_FAKE 0  /* nothing attached: made-up readings, to see that all the rest works */
#define SENSORS_WIRED 1 /* what the table `sources` says */
#define SENSORS_LINES 2 /* another board, or a computer, sends frames as lines on LINE_PORT */
#ifndef SENSORS
#define SENSORS SENSORS_FAKE
#endif

#define LINE_PORT Serial /* where lines go, and come from; 115200 baud as the computer expects */
#ifndef TELL_ANSWERS
#define TELL_ANSWERS (SENSORS == SENSORS_LINES) /* 1: a line for each answer, for your eyes, instead of the frames */
#endif

static const uint8_t eye_pins[3] = {@eyes@}; /* PWM: red, green, blue */
static const uint8_t voice_pin = @voice@;            /* a piezo buzzer */

/* ---- Sensors --------------------------------------------------------------------------------------------------- */

#if SENSORS == SENSORS_WIRED
/* CHECK EVERY LINE against your wiring. The network knows the numbers of the toy that its recordings were made with:
 * the same sensors, sign, scale and order, or its answers mean nothing. Surest is to record with this very sketch. */
@sources@

@if motion@
/* MPU-6050 on I2C: +-2 g (16384 a g) and +-250 degrees/s (131 a degree/s), low pass at 44 Hz. */
static const uint8_t MOTION_ADDRESS = 0x68;

static void motion_register(uint8_t number, uint8_t value)
{
    Wire.beginTransmission(MOTION_ADDRESS);
    Wire.write(number);
    Wire.write(value);
    Wire.endTransmission();
}

static void begin_motion()
{
    Wire.begin();
    Wire.setClock(400000);
#if defined(ARDUINO_ARCH_ESP32)
    Wire.setTimeOut(5); /* ms: a sensor that hangs must not hold the toy up */
#endif
    motion_register(0x6B, 0x01); /* PWR_MGMT_1: awake, clock of the gyroscope */
    motion_register(0x1A, 0x03); /* CONFIG: low pass */
    motion_register(0x1B, 0x00); /* GYRO_CONFIG: 250 degrees/s */
    motion_register(0x1C, 0x00); /* ACCEL_CONFIG: 2 g */
}

/* Acceleration x, y, z and rotation x, y, z. Returns false when the sensor does not answer. */
static bool read_motion(int16_t motion[6])
{
    Wire.beginTransmission(MOTION_ADDRESS);
    Wire.write(static_cast<uint8_t>(0x3B)); /* ACCEL_XOUT_H; then y, z, temperature, rotation x, y, z */
    if (Wire.endTransmission(false) != 0 || Wire.requestFrom(MOTION_ADDRESS, static_cast<uint8_t>(14)) != 14)
        return false;
    for (int i = 0; i < 7; i++) {
        uint8_t high = static_cast<uint8_t>(Wire.read()), low = static_cast<uint8_t>(Wire.read());

        if (i != 3)
            motion[i < 3 ? i : i - 1] = static_cast<int16_t>(high << 8 | low);
    }
    return true;
}

@end@
@if touch@
static int32_t read_touch(uint8_t pin)
{
#if defined(ARDUINO_ARCH_ESP32)
    return static_cast<int32_t>(touchRead(pin)); /* falls when touched on the ESP32, rises on the S2 and S3 */
#else
#error "touchRead() is the ESP32's: read your own touch sensors here."
#endif
}

@end@
@if other@
/* YOURS TO WRITE: the channels that neither a touch pad nor the MPU-6050 measures. */
static int32_t read_other(uint8_t channel)
{
    (void)channel;
    return MISSING;
}

@end@
static void read_sensors(uint32_t, int32_t *values)
{
@read@
}
#elif SENSORS == SENSORS_FAKE
/* The working stand-in while nothing is attached. */
static void read_sensors(uint32_t ms, int32_t *values)
{
    plush_fake(ms, values);
}
#endif

/* ---- Eyes and voice -------------------------------------------------------------------------------------------- */

static void show(const plush_look &look)
{
    static uint16_t sounding;

    analogWrite(eye_pins[0], look.red);
    analogWrite(eye_pins[1], look.green);
    analogWrite(eye_pins[2], look.blue);
    if (look.tone_hz == sounding)
        return;
    sounding = look.tone_hz;
    if (sounding != 0)
        tone(voice_pin, sounding);
    else
        noTone(voice_pin);
}

/* ---- Lines ----------------------------------------------------------------------------------------------------- */

/* Feeling goes before telling: a line for which there is no room now is left out, rather than to wait. The computer
 * sees it as a lost frame. (On a board whose availableForWrite() is always 0, write without asking.) */
static void tell(const char *line, uint32_t n)
{
    if (LINE_PORT.availableForWrite() >= static_cast<int>(n))
        LINE_PORT.write(reinterpret_cast<const uint8_t *>(line), n);
}

static void tell_answer(const plush_toy *toy, void *)
{
    const plush_answer &a = toy->answer;
    char line[64 + 256];
    int n = a.state == PLUSH_WARMING
                ? snprintf(line, sizeof line, "%lu warming\n", static_cast<unsigned long>(a.ms))
                : snprintf(line, sizeof line, "%lu %u %u/32768 %.255s\n", static_cast<unsigned long>(a.ms), a.gesture,
                           a.confidence, plush_gesture_name(toy, a.gesture));

    tell(line, static_cast<uint32_t>(n));
}

/* ---- setup() and loop() ---------------------------------------------------------------------------------------- */

static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];
static plush_toy toy;
static plush_status status;
static plush_reaction reaction;

static void frame(uint32_t ms, const int32_t *values)
{
    static uint32_t before;
    static bool any;

    if (status == PLUSH_OK)
        plush_push(&toy, ms, values);
    if (!TELL_ANSWERS) {
        char line[PLUSH_WIRE_BYTES];

        tell(line, plush_wire_write(line, ms, any ? ms - before : 0, values));
    }
    before = ms;
    any = true;
}

void setup()
{
#if defined(ARDUINO_ARCH_ESP32)
    LINE_PORT.setTxBufferSize(1024); /* before begin(): a whole line must fit */
#endif
    LINE_PORT.begin(115200);
    for (uint8_t pin : eye_pins)
        pinMode(pin, OUTPUT);
    pinMode(voice_pin, OUTPUT);
@if motion@
#if SENSORS == SENSORS_WIRED
    begin_motion();
#endif
@end@
    /* When it fails (the model's bytes are damaged, or of another version) the toy does not feel: its eyes blink the
     * status, and it still reads and sends its frames, so that recording goes on. plushsense.h tells each status. */
    status = plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory);
    if (TELL_ANSWERS)
        toy.on_answer = tell_answer;
}

/* Missed ticks. Due times stand on a grid of @period@ ms that does not drift. Whoever comes late reads once, now, with
 * the true time; ticks that went by meanwhile are not made up for. The library bridges up to @gap@ ms by interpolation
 * and gives every answer that fell due; after a longer gap it is warming again, for @warm@ s. */
void loop()
{
    static uint32_t due_us = micros();
    const uint32_t now_us = micros();
    int32_t values[PLUSH_MODEL_CHANNELS];
    plush_look look;

#if SENSORS == SENSORS_LINES
    static plush_wire wire;
    uint32_t sent_ms;

    while (LINE_PORT.available() > 0)
        if (plush_wire_read(&wire, static_cast<char>(LINE_PORT.read()), &sent_ms, values))
            frame(sent_ms, values);
#endif
    if (static_cast<int32_t>(now_us - due_us) < 0)
        return;
    due_us += (now_us - due_us) / PLUSH_MODEL_PERIOD_US * PLUSH_MODEL_PERIOD_US + PLUSH_MODEL_PERIOD_US;

    const uint32_t ms = millis();
#if SENSORS != SENSORS_LINES
    read_sensors(ms, values);
    frame(ms, values);
#endif
    if (status == PLUSH_OK)
        plush_react(&reaction, &toy, ms, &look);
    else
        plush_show_failure(status, ms, &look);
    show(look);
}
