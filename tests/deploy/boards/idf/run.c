/* Runs app_main() for some seconds: run SECONDS [LINES]. Standard output: what it sends; standard error: what changes.
 * 5 s and 9 s after the start the program is held up, for 37 and 250 ms. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "idf.h"

#ifndef LOOK_US /* that looking at the clock takes */
#define LOOK_US 200
#endif

#ifdef NO_MOTION
#define MOTION 0
#else
#define MOTION 1
#endif

static int64_t now, end;
static unsigned held;
static int64_t free_at;
static FILE *lines;
static uint32_t duty[4], shown[4];

void app_main(void);

int main(int argc, char **argv)
{
    end = (int64_t)(atof(argv[1]) * 1e6);
    if (argc > 2)
        lines = fopen(argv[2], "rb");
    app_main();
    return 1;
}

int64_t esp_timer_get_time(void)
{
    now += LOOK_US;
    if (now > 5000000 && held == 0) {
        held = 1;
        now += 37000;
    }
    if (now > 9000000 && held == 1) {
        held = 2;
        now += 250000;
    }
    if (now >= end)
        exit(0);
    return now;
}

void esp_check(esp_err_t result)
{
    if (result != ESP_OK)
        exit(3);
}

/* The scheduler's tick is 1 ms: a task sleeps until a tick, not for a time. */
void vTaskDelay(TickType_t ticks)
{
    now = (now / 1000 + ticks) * 1000;
}

esp_err_t uart_driver_install(uart_port_t port, int rx, int tx, int queue_size, QueueHandle_t *queue, int flags)
{
    return port == 0 && rx > 128 && tx > 128 && queue_size == 0 && queue == NULL && flags == 0 ? ESP_OK : -1;
}

esp_err_t uart_param_config(uart_port_t port, const uart_config_t *config)
{
    return port == 0 && config->baud_rate == 115200 ? ESP_OK : -1;
}

esp_err_t uart_get_tx_buffer_free_size(uart_port_t port, size_t *size)
{
    *size = 1024 - (size_t)(free_at > now ? (free_at - now) * 11520 / 1000000 : 0);
    return port;
}

int uart_write_bytes(uart_port_t port, const void *source, size_t size)
{
    free_at = (free_at > now ? free_at : now) + (int64_t)size * 1000000 / 11520;
    return port + (int)fwrite(source, 1, size, stdout);
}

int uart_read_bytes(uart_port_t port, void *to, uint32_t length, TickType_t wait)
{
    static int64_t heard;
    int64_t come = now * 11520 / 1000000 - heard;
    int n = lines == NULL ? 0 : (int)fread(to, 1, (size_t)(come < length ? come : length), lines);

    heard += n;
    return port + (int)wait + n;
}

esp_err_t ledc_timer_config(const ledc_timer_config_t *config)
{
    return config->freq_hz > 0 ? ESP_OK : -1;
}

esp_err_t ledc_channel_config(const ledc_channel_config_t *config)
{
    return config->gpio_num > 0 ? ESP_OK : -1;
}

esp_err_t ledc_set_duty(ledc_mode_t mode, ledc_channel_t channel, uint32_t to)
{
    duty[channel] = to;
    return mode - LEDC_LOW_SPEED_MODE;
}

esp_err_t ledc_update_duty(ledc_mode_t mode, ledc_channel_t channel)
{
    if (shown[channel] != duty[channel])
        fprintf(stderr, "%u %d %u\n", (unsigned)(now / 1000), (int)channel, (unsigned)duty[channel]);
    shown[channel] = duty[channel];
    return mode - LEDC_LOW_SPEED_MODE;
}

esp_err_t ledc_set_freq(ledc_mode_t mode, ledc_timer_t timer, uint32_t hz)
{
    return mode == LEDC_LOW_SPEED_MODE && timer == LEDC_TIMER_1 && hz > 0 ? ESP_OK : -1;
}

esp_err_t i2c_new_master_bus(const i2c_master_bus_config_t *config, i2c_master_bus_handle_t *bus)
{
    *bus = NULL;
    return config->sda_io_num != config->scl_io_num ? ESP_OK : -1;
}

esp_err_t i2c_master_bus_add_device(i2c_master_bus_handle_t bus, const i2c_device_config_t *config,
                                    i2c_master_dev_handle_t *device)
{
    *device = NULL;
    return bus == NULL && config->device_address == 0x68 ? ESP_OK : -1;
}

esp_err_t i2c_master_transmit(i2c_master_dev_handle_t device, const uint8_t *bytes, size_t n, int wait_ms)
{
    return device == NULL && bytes != NULL && n == 2 && wait_ms > 0 ? ESP_OK : -1;
}

esp_err_t i2c_master_transmit_receive(i2c_master_dev_handle_t device, const uint8_t *bytes, size_t n, uint8_t *to,
                                      size_t size, int wait_ms)
{
    size_t i;

    for (i = 0; i < size; i++)
        to[i] = (uint8_t)(bytes[0] + i);
    return MOTION && device == NULL && n == 1 && wait_ms > 0 ? ESP_OK : -1;
}

esp_err_t touch_pad_init(void)
{
    return ESP_OK;
}

esp_err_t touch_pad_set_fsm_mode(touch_fsm_mode_t mode)
{
    return (int)mode;
}

esp_err_t touch_pad_config(touch_pad_t pad, uint16_t threshold)
{
    return (int)pad <= 9 && threshold == 0 ? ESP_OK : -1;
}

esp_err_t touch_pad_read(touch_pad_t pad, uint16_t *value)
{
    *value = (uint16_t)(1000 + 10 * (int)pad);
    return ESP_OK;
}
