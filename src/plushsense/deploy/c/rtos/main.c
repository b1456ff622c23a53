/*
 * A toy in three tasks, for ESP-IDF 5.2 and newer with FreeRTOS and the Bluetooth stack NimBLE:
 *
 *     sample   takes a reading when it is due, whatever the others do, and puts it into a queue
 *     feel     gives the readings to the library, on a core of its own where there are two: the only one that touches it
 *     notify   tells a connected phone of every beginning, name and end of an event
 *
 * toy_snapshot() says to any task what goes on now; the phone reads it, too.
 *
 * In order: settings - what tasks pass on - sample - feel - notify - Bluetooth - app_main().
 */
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "esp_err.h"
#include "esp_timer.h"
#include "freertos/FreeRTOS.h"
#include "freertos/queue.h"
#include "freertos/task.h"
#include "host/ble_hs.h"
#include "nimble/nimble_port.h"
#include "nimble/nimble_port_freertos.h"
#include "nvs_flash.h"
#include "plush_fake.h"
#include "plush_model.h"
#include "plushsense.h"
#include "services/gap/ble_svc_gap.h"
#include "services/gatt/ble_svc_gatt.h"

/* ---- Settings: yours to change --------------------------------------------------------------------------------- */

#define NAME "PlushToy"
#if CONFIG_FREERTOS_UNICORE
#define FEEL_CORE 0
#else
#define FEEL_CORE 1 /* Bluetooth runs on core 0 */
#endif
/* Sampling goes first: it takes little time, and must be on time. */
#define SAMPLE_PRIORITY 12
#define FEEL_PRIORITY 10
#define NOTIFY_PRIORITY 5
#define STACK_BYTES 4096
#define WAITING_FRAMES 64 /* how long `feel` may be busy */
#define WAITING_EVENTS 16
#define SILENCE_MS 300 /* without a reading, what goes on ends */

/* YOURS TO WRITE: made-up readings until then. The example PlushToy reads touch pads and a motion sensor. */
static void read_sensors(uint32_t ms, int32_t *values)
{
    plush_fake(ms, values);
}

/* ---- What tasks pass on ---------------------------------------------------------------------------------------- */

typedef struct {
    uint32_t ms;
    int32_t values[PLUSH_MODEL_CHANNELS];
} toy_frame;

/* What goes on, as of one moment. */
typedef struct {
    plush_status status; /* unless PLUSH_OK, the toy does not feel */
    plush_answer answer;
    plush_event event; /* the newest; going on unless it has ended */
    uint32_t restarts, faults;
} toy_state;

static QueueHandle_t frames; /* sample -> feel */
static QueueHandle_t events; /* feel -> notify */
static QueueHandle_t latest; /* feel -> any: one toy_state, overwritten */
static volatile uint32_t lost_frames, lost_events; /* there was no room in the queue */

/* Copies what goes on; false before there is anything. May be called by every task, but not by an interrupt. */
static bool toy_snapshot(toy_state *state)
{
    return xQueuePeek(latest, state, 0) == pdTRUE;
}

/* ---- Sample ---------------------------------------------------------------------------------------------------- */

/* Due times stand on a grid that does not drift. Who comes late reads once, with the true time; ticks that went by are not
 * made up for, and the library bridges them. */
static void sample(void *unused)
{
    int64_t due_us = esp_timer_get_time();
    toy_frame frame;

    (void)unused;
    for (;;) {
        int64_t now_us = esp_timer_get_time();

        if (now_us < due_us) {
            TickType_t wait = pdMS_TO_TICKS((uint32_t)((due_us - now_us) / 1000));

            vTaskDelay(wait > 0 ? wait : 1);
            continue;
        }
        due_us = (now_us / PLUSH_MODEL_PERIOD_US + 1) * PLUSH_MODEL_PERIOD_US;
        frame.ms = (uint32_t)(now_us / 1000);
        read_sensors(frame.ms, frame.values);
        if (xQueueSend(frames, &frame, 0) != pdTRUE) /* `feel` sees a gap */
            lost_frames++;
    }
}

/* ---- Feel ------------------------------------------------------------------------------------------------------ */

static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];
static plush_toy toy;

/* Runs within plush_push(): it copies, and never waits. */
static void on_event(const plush_toy *of, void *user)
{
    (void)user;
    if (xQueueSend(events, &of->event, 0) != pdTRUE)
        lost_events++;
}

static void feel(void *unused)
{
    static toy_state state; /* not on the stack */
    toy_frame frame;
    bool silent = false;

    (void)unused;
    state.status = plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory);
    toy.on_event = on_event;
    for (;;) {
        if (xQueueReceive(frames, &frame, pdMS_TO_TICKS(SILENCE_MS)) == pdTRUE) {
            plush_push(&toy, frame.ms, frame.values); /* of a toy that has not begun: nothing */
            silent = false;
        } else if (!silent) {
            plush_silence(&toy);
            silent = true;
        }
        state.answer = toy.answer;
        state.event = toy.event;
        state.restarts = toy.restarts;
        state.faults = toy.faults;
        xQueueOverwrite(latest, &state);
    }
}

/* ---- Notify ---------------------------------------------------------------------------------------------------- */

static volatile uint16_t phone = BLE_HS_CONN_HANDLE_NONE; /* that wants to be told */
static uint16_t event_handle;

/* An event in 12 bytes: number, ms, what, affect, gesture, source; numbers begin with their lowest byte. */
static void put_event(uint8_t bytes[12], const plush_event *event)
{
    uint32_t i;

    for (i = 0; i < 4; i++) {
        bytes[i] = (uint8_t)(event->number >> (8 * i));
        bytes[4 + i] = (uint8_t)(event->ms >> (8 * i));
    }
    bytes[8] = (uint8_t)event->what;
    bytes[9] = (uint8_t)event->affect;
    bytes[10] = event->gesture;
    bytes[11] = (uint8_t)event->source;
}

static void notify(void *unused)
{
    plush_event event;
    uint8_t bytes[12];

    (void)unused;
    for (;;) {
        uint16_t to;
        struct os_mbuf *packet;

        if (xQueueReceive(events, &event, portMAX_DELAY) != pdTRUE)
            continue;
        to = phone;
        if (to == BLE_HS_CONN_HANDLE_NONE)
            continue;
        put_event(bytes, &event);
        packet = ble_hs_mbuf_from_flat(bytes, sizeof bytes);
        if (packet == NULL || ble_gatts_notify_custom(to, event_handle, packet) != 0) /* the packet is freed by it */
            lost_events++;
    }
}

/* ---- Bluetooth ------------------------------------------------------------------------------------------------- */

/* Made up for this example: 4d9a0001-7c1e-4f0b-9b0e-2f6d5a3c8e10, and 0002. */
static const ble_uuid128_t service_id = BLE_UUID128_INIT(0x10, 0x8e, 0x3c, 0x5a, 0x6d, 0x2f, 0x0e, 0x9b, 0x0b, 0x4f, 0x1e,
                                                         0x7c, 0x01, 0x00, 0x9a, 0x4d);
static const ble_uuid128_t event_id = BLE_UUID128_INIT(0x10, 0x8e, 0x3c, 0x5a, 0x6d, 0x2f, 0x0e, 0x9b, 0x0b, 0x4f, 0x1e,
                                                       0x7c, 0x02, 0x00, 0x9a, 0x4d);

/* A phone reads the newest event. */
static int on_read(uint16_t connection, uint16_t attribute, struct ble_gatt_access_ctxt *context, void *user)
{
    toy_state state;
    uint8_t bytes[12];

    (void)connection;
    (void)attribute;
    (void)user;
    if (!toy_snapshot(&state))
        return BLE_ATT_ERR_UNLIKELY;
    put_event(bytes, &state.event);
    return os_mbuf_append(context->om, bytes, sizeof bytes) == 0 ? 0 : BLE_ATT_ERR_INSUFFICIENT_RES;
}

static const struct ble_gatt_chr_def characteristics[] = {
    {.uuid = &event_id.u,
     .access_cb = on_read,
     .flags = BLE_GATT_CHR_F_READ | BLE_GATT_CHR_F_NOTIFY,
     .val_handle = &event_handle},
    {.uuid = NULL},
};
static const struct ble_gatt_svc_def services[] = {
    {.type = BLE_GATT_SVC_TYPE_PRIMARY, .uuid = &service_id.u, .characteristics = characteristics},
    {.type = 0},
};

static void advertise(void);

static int on_connection(struct ble_gap_event *event, void *user)
{
    (void)user;
    switch (event->type) {
    case BLE_GAP_EVENT_CONNECT:
        if (event->connect.status != 0)
            advertise();
        break;
    case BLE_GAP_EVENT_DISCONNECT:
        phone = BLE_HS_CONN_HANDLE_NONE;
        advertise();
        break;
    case BLE_GAP_EVENT_SUBSCRIBE:
        if (event->subscribe.attr_handle == event_handle)
            phone = event->subscribe.cur_notify ? event->subscribe.conn_handle : BLE_HS_CONN_HANDLE_NONE;
        break;
    default:
        break;
    }
    return 0;
}

static void advertise(void)
{
    struct ble_gap_adv_params how = {.conn_mode = BLE_GAP_CONN_MODE_UND, .disc_mode = BLE_GAP_DISC_MODE_GEN};
    struct ble_hs_adv_fields what;
    uint8_t address;

    memset(&what, 0, sizeof what);
    what.flags = BLE_HS_ADV_F_DISC_GEN | BLE_HS_ADV_F_BREDR_UNSUP;
    what.name = (const uint8_t *)NAME;
    what.name_len = (uint8_t)strlen(NAME);
    what.name_is_complete = 1;
    if (ble_hs_id_infer_auto(0, &address) == 0 && ble_gap_adv_set_fields(&what) == 0)
        ble_gap_adv_start(address, NULL, BLE_HS_FOREVER, &how, on_connection, NULL);
}

static void run_bluetooth(void *unused)
{
    (void)unused;
    nimble_port_run();
    nimble_port_freertos_deinit();
}

static void begin_bluetooth(void)
{
    ESP_ERROR_CHECK(nvs_flash_init());
    ESP_ERROR_CHECK(nimble_port_init());
    ble_svc_gap_init();
    ble_svc_gatt_init();
    if (ble_gatts_count_cfg(services) != 0 || ble_gatts_add_svcs(services) != 0 || ble_svc_gap_device_name_set(NAME) != 0)
        abort();
    ble_hs_cfg.sync_cb = advertise;
    nimble_port_freertos_init(run_bluetooth);
}

/* ---- app_main() ------------------------------------------------------------------------------------------------ */

void app_main(void)
{
    frames = xQueueCreate(WAITING_FRAMES, sizeof(toy_frame));
    events = xQueueCreate(WAITING_EVENTS, sizeof(plush_event));
    latest = xQueueCreate(1, sizeof(toy_state));
    if (frames == NULL || events == NULL || latest == NULL)
        abort();
    begin_bluetooth();
    if (xTaskCreatePinnedToCore(feel, "feel", STACK_BYTES, NULL, FEEL_PRIORITY, NULL, FEEL_CORE) != pdPASS ||
        xTaskCreatePinnedToCore(notify, "notify", STACK_BYTES, NULL, NOTIFY_PRIORITY, NULL, 0) != pdPASS ||
        xTaskCreatePinnedToCore(sample, "sample", STACK_BYTES, NULL, SAMPLE_PRIORITY, NULL, 0) != pdPASS)
        abort();
}
