/*
 * A toy that feels: @title@, @layout@, @n_channels@ channels, @n_classes@ gestures. For ESP-IDF 5.2 to 5.x.
 *
 * Every @period@ ms it reads its sensors, gives the readings to the library, shows with its eyes and its voice what it
 * felt, and sends the readings on as a line, so that `plushsense record` and `plushsense live` work with this toy too.
 *
 * In order: settings - sensors - eyes and voice - lines - app_main().
 */
#include <stdbool.h>
#include <stdio.h>

#include "driver/ledc.h"
#include "driver/uart.h"
#include "esp_err.h"
#include "esp_timer.h"
#include "freertos/FreeRTOS.h"
#include "freertos/task.h"
#include "plush_fake.h"
#include "plush_model.h"
#include "plush_reaction.h"
#include "plush_wire.h"
#include "plushsense.h"

/* ---- Settings: yours to change --------------------------------------------------------------------------------- */

#define SENSORS_FAKE 0  /* nothing attached: made-up readings, to see that all the rest works */
#define SENSORS_WIRED 1 /* what the table `sources` says */
#define SENSORS_LINES 2 /* another board, or a computer, sends frames as lines on LINE_PORT */
#ifndef SENSORS
#define SENSORS SENSORS_FAKE
#endif

#define LINE_PORT UART_NUM_0 /* where lines go, and come from; sdkconfig.defaults keeps the log away from it */
#ifndef TELL_ANSWERS
#define TELL_ANSWERS (SENSORS == SENSORS_LINES) /* 1: a line for each answer, for your eyes, instead of the frames */
#endif

static const int eye_pins[3] = {@eyes@}; /* red, green, blue */
static const int voice_pin = @voice@;            /* a piezo buzzer */

/* ---- Sensors --------------------------------------------------------------------------------------------------- */

#if SENSORS == SENSORS_WIRED
@if motion@
#include "driver/i2c_master.h"
@end@
@if touch@
#include "driver/touch_pad.h"
@end@

/* CHECK EVERY LINE against your wiring. The network knows the numbers of the toy that its recordings were made with:
 * the same sensors, sign, scale and order, or its answers mean nothing. Surest is to record with this very program. */
@sources@

@if motion@
/* MPU-6050 on I2C: +-2 g (16384 a g) and +-250 degrees/s (131 a degree/s), low pass at 44 Hz. */
#define MOTION_ADDRESS 0x68
#define MOTION_SDA 21
#define MOTION_SCL 22
#define MOTION_WAIT_MS 5

static i2c_master_dev_handle_t motion_sensor;

static void begin_motion(void)
{
    static const uint8_t registers[][2] = {
        {0x6B, 0x01}, /* PWR_MGMT_1: awake, clock of the gyroscope */
        {0x1A, 0x03}, /* CONFIG: low pass */
        {0x1B, 0x00}, /* GYRO_CONFIG: 250 degrees/s */
        {0x1C, 0x00}, /* ACCEL_CONFIG: 2 g */
    };
    i2c_master_bus_config_t bus = {
        .i2c_port = -1,
        .sda_io_num = MOTION_SDA,
        .scl_io_num = MOTION_SCL,
        .clk_source = I2C_CLK_SRC_DEFAULT,
        .glitch_ignore_cnt = 7,
        .flags.enable_internal_pullup = true,
    };
    i2c_device_config_t device = {
        .dev_addr_length = I2C_ADDR_BIT_LEN_7,
        .device_address = MOTION_ADDRESS,
        .scl_speed_hz = 400000,
    };
    i2c_master_bus_handle_t handle;
    size_t i;

    ESP_ERROR_CHECK(i2c_new_master_bus(&bus, &handle));
    ESP_ERROR_CHECK(i2c_master_bus_add_device(handle, &device, &motion_sensor));
    for (i = 0; i < sizeof registers / sizeof registers[0]; i++)
        i2c_master_transmit(motion_sensor, registers[i], 2, MOTION_WAIT_MS);
}

/* Acceleration x, y, z and rotation x, y, z. Returns false when the sensor does not answer. */
static bool read_motion(int16_t motion[6])
{
    static const uint8_t first = 0x3B; /* ACCEL_XOUT_H; then y, z, temperature, rotation x, y, z */
    uint8_t bytes[14];
    int i;

    if (i2c_master_transmit_receive(motion_sensor, &first, 1, bytes, sizeof bytes, MOTION_WAIT_MS) != ESP_OK)
        return false;
    for (i = 0; i < 7; i++)
        if (i != 3)
            motion[i < 3 ? i : i - 1] = (int16_t)(bytes[2 * i] << 8 | bytes[2 * i + 1]);
    return true;
}

@end@
@if touch@
/* The touch driver of the ESP32; the S2 and S3 have others. Its numbers fall when touched. */
static void begin_touch(void)
{
    size_t i;

    ESP_ERROR_CHECK(touch_pad_init());
    ESP_ERROR_CHECK(touch_pad_set_fsm_mode(TOUCH_FSM_MODE_TIMER));
    for (i = 0; i < PLUSH_MODEL_CHANNELS; i++)
        if (sources[i].from == FROM_TOUCH)
            ESP_ERROR_CHECK(touch_pad_config((touch_pad_t)sources[i].number, 0));
}

static int32_t read_touch(uint8_t pad)
{
    uint16_t value;

    return touch_pad_read((touch_pad_t)pad, &value) == ESP_OK ? value : MISSING;
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
static void begin_sensors(void)
{
@if touch@
    begin_touch();
@end@
@if motion@
    begin_motion();
@end@
}

static void read_sensors(uint32_t ms, int32_t *values)
{
    (void)ms;
@read@
}
#elif SENSORS == SENSORS_FAKE
/* The working stand-in while nothing is attached. */
static void begin_sensors(void)
{
}

static void read_sensors(uint32_t ms, int32_t *values)
{
    plush_fake(ms, values);
}
#endif

/* ---- Eyes and voice -------------------------------------------------------------------------------------------- */

#define VOICE_CHANNEL LEDC_CHANNEL_3

static void begin_show(void)
{
    ledc_timer_config_t eyes = {.speed_mode = LEDC_LOW_SPEED_MODE,
                                .duty_resolution = LEDC_TIMER_8_BIT,
                                .timer_num = LEDC_TIMER_0,
                                .freq_hz = 1000,
                                .clk_cfg = LEDC_AUTO_CLK};
    ledc_timer_config_t voice = {.speed_mode = LEDC_LOW_SPEED_MODE,
                                 .duty_resolution = LEDC_TIMER_10_BIT,
                                 .timer_num = LEDC_TIMER_1,
                                 .freq_hz = 1000,
                                 .clk_cfg = LEDC_AUTO_CLK};
    int i;

    ESP_ERROR_CHECK(ledc_timer_config(&eyes));
    ESP_ERROR_CHECK(ledc_timer_config(&voice));
    for (i = 0; i < 4; i++) {
        ledc_channel_config_t channel = {.gpio_num = i < 3 ? eye_pins[i] : voice_pin,
                                         .speed_mode = LEDC_LOW_SPEED_MODE,
                                         .channel = (ledc_channel_t)i,
                                         .timer_sel = i < 3 ? LEDC_TIMER_0 : LEDC_TIMER_1,
                                         .duty = 0,
                                         .hpoint = 0};

        ESP_ERROR_CHECK(ledc_channel_config(&channel));
    }
}

static void set_duty(ledc_channel_t channel, uint32_t duty)
{
    ledc_set_duty(LEDC_LOW_SPEED_MODE, channel, duty);
    ledc_update_duty(LEDC_LOW_SPEED_MODE, channel);
}

static void show(const plush_look *look)
{
    static uint16_t sounding;

    set_duty(LEDC_CHANNEL_0, look->red);
    set_duty(LEDC_CHANNEL_1, look->green);
    set_duty(LEDC_CHANNEL_2, look->blue);
    if (look->tone_hz == sounding)
        return;
    sounding = look->tone_hz;
    if (sounding != 0)
        ledc_set_freq(LEDC_LOW_SPEED_MODE, LEDC_TIMER_1, sounding);
    set_duty(VOICE_CHANNEL, sounding != 0 ? 512 : 0);
}

/* ---- Lines ----------------------------------------------------------------------------------------------------- */

static void begin_lines(void)
{
    uart_config_t port = {.baud_rate = 115200, /* as the computer expects */
                          .data_bits = UART_DATA_8_BITS,
                          .parity = UART_PARITY_DISABLE,
                          .stop_bits = UART_STOP_BITS_1,
                          .flow_ctrl = UART_HW_FLOWCTRL_DISABLE,
                          .source_clk = UART_SCLK_DEFAULT};

    ESP_ERROR_CHECK(uart_driver_install(LINE_PORT, 1024, 1024, 0, NULL, 0));
    ESP_ERROR_CHECK(uart_param_config(LINE_PORT, &port));
}

/* Feeling goes before telling: a line for which there is no room now is left out, rather than to wait. The computer
 * sees it as a lost frame. */
static void tell(const char *line, uint32_t n)
{
    size_t room = 0;

    if (uart_get_tx_buffer_free_size(LINE_PORT, &room) == ESP_OK && room >= n)
        uart_write_bytes(LINE_PORT, line, n);
}

static void tell_answer(const plush_toy *toy, void *user)
{
    const plush_answer *a = &toy->answer;
    char line[64 + 256];
    int n;

    (void)user;
    if (a->state == PLUSH_WARMING)
        n = snprintf(line, sizeof line, "%lu warming\n", (unsigned long)a->ms);
    else
        n = snprintf(line, sizeof line, "%lu %u %u/32768 %.255s\n", (unsigned long)a->ms, a->gesture, a->confidence,
                     plush_gesture_name(toy, a->gesture));
    tell(line, (uint32_t)n);
}

/* ---- app_main() ------------------------------------------------------------------------------------------------ */

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

#if SENSORS == SENSORS_LINES
/* What has come meanwhile, each frame with its sender's time. */
static void hear(void)
{
    static plush_wire wire;
    int32_t values[PLUSH_MODEL_CHANNELS];
    uint32_t ms;
    char heard[128];
    int n, i;

    while ((n = uart_read_bytes(LINE_PORT, heard, sizeof heard, 0)) > 0)
        for (i = 0; i < n; i++)
            if (plush_wire_read(&wire, heard[i], &ms, values))
                frame(ms, values);
}
#endif

/* Missed ticks. Due times stand on a grid of @period@ ms that does not drift. Whoever comes late reads once, now, with
 * the true time; ticks that went by meanwhile are not made up for. The library bridges up to @gap@ ms by interpolation
 * and gives every answer that fell due; after a longer gap it is warming again, for @warm@ s. */
static void tick(void)
{
    static int64_t due_us;
    int64_t now_us = esp_timer_get_time();
    uint32_t ms;
    plush_look look;

    if (now_us < due_us) {
        TickType_t wait = (TickType_t)((due_us - now_us) / (1000 * portTICK_PERIOD_MS));

        vTaskDelay(wait > 0 ? wait : 1);
        return;
    }
    due_us = (now_us / PLUSH_MODEL_PERIOD_US + 1) * PLUSH_MODEL_PERIOD_US;
    ms = (uint32_t)(now_us / 1000);
#if SENSORS == SENSORS_LINES
    hear();
#else
    int32_t values[PLUSH_MODEL_CHANNELS];

    read_sensors(ms, values);
    frame(ms, values);
#endif
    if (status == PLUSH_OK)
        plush_react(&reaction, &toy, ms, &look);
    else
        plush_show_failure(status, ms, &look);
    show(&look);
}

void app_main(void)
{
    begin_lines();
    begin_show();
#if SENSORS != SENSORS_LINES
    begin_sensors();
#endif
    /* When it fails (the model's bytes are damaged, or of another version) the toy does not feel: its eyes blink the
     * status, and it still reads and sends its frames, so that recording goes on. plushsense.h tells each status. */
    status = plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory);
    if (TELL_ANSWERS)
        toy.on_answer = tell_answer;
    for (;;)
        tick();
}
