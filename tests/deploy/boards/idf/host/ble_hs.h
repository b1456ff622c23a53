/* As much of NimBLE as the example RtosToy asks for, with the names and types of its headers: to check the syntax only. */
#ifndef BLE_HS_H
#define BLE_HS_H
#include "idf.h"

struct os_mbuf;
int os_mbuf_append(struct os_mbuf *packet, const void *bytes, uint16_t n);
struct os_mbuf *ble_hs_mbuf_from_flat(const void *bytes, uint16_t n);

typedef struct {
    uint8_t type;
} ble_uuid_t;
typedef struct {
    ble_uuid_t u;
    uint8_t value[16];
} ble_uuid128_t;
#define BLE_UUID128_INIT(...) {.u = {128}, .value = {__VA_ARGS__}}

#define BLE_HS_CONN_HANDLE_NONE 0xffff
#define BLE_HS_FOREVER INT32_MAX
#define BLE_ATT_ERR_UNLIKELY 0x0e
#define BLE_ATT_ERR_INSUFFICIENT_RES 0x11

struct ble_gatt_access_ctxt {
    uint8_t op;
    struct os_mbuf *om;
};
typedef int ble_gatt_access_fn(uint16_t connection, uint16_t attribute, struct ble_gatt_access_ctxt *context, void *user);
#define BLE_GATT_CHR_F_READ 0x0002
#define BLE_GATT_CHR_F_NOTIFY 0x0010
struct ble_gatt_chr_def {
    const ble_uuid_t *uuid;
    ble_gatt_access_fn *access_cb;
    void *arg;
    struct ble_gatt_dsc_def *descriptors;
    uint32_t flags;
    uint8_t min_key_size;
    uint16_t *val_handle;
};
#define BLE_GATT_SVC_TYPE_PRIMARY 1
struct ble_gatt_svc_def {
    uint8_t type;
    const ble_uuid_t *uuid;
    const struct ble_gatt_svc_def **includes;
    const struct ble_gatt_chr_def *characteristics;
};
int ble_gatts_count_cfg(const struct ble_gatt_svc_def *services);
int ble_gatts_add_svcs(const struct ble_gatt_svc_def *services);
int ble_gatts_notify_custom(uint16_t connection, uint16_t attribute, struct os_mbuf *packet);

#define BLE_GAP_EVENT_CONNECT 0
#define BLE_GAP_EVENT_DISCONNECT 1
#define BLE_GAP_EVENT_SUBSCRIBE 14
struct ble_gap_event {
    uint8_t type;
    union {
        struct {
            int status;
            uint16_t conn_handle;
        } connect;
        struct {
            uint16_t conn_handle;
            uint16_t attr_handle;
            uint8_t reason;
            uint8_t prev_notify : 1;
            uint8_t cur_notify : 1;
        } subscribe;
    };
};
typedef int ble_gap_event_fn(struct ble_gap_event *event, void *user);
typedef struct {
    uint8_t type;
    uint8_t val[6];
} ble_addr_t;
#define BLE_GAP_CONN_MODE_UND 2
#define BLE_GAP_DISC_MODE_GEN 2
struct ble_gap_adv_params {
    uint8_t conn_mode;
    uint8_t disc_mode;
};
#define BLE_HS_ADV_F_DISC_GEN 0x02
#define BLE_HS_ADV_F_BREDR_UNSUP 0x04
struct ble_hs_adv_fields {
    uint8_t flags;
    const uint8_t *name;
    uint8_t name_len;
    unsigned name_is_complete : 1;
};
int ble_hs_id_infer_auto(int privacy, uint8_t *address);
int ble_gap_adv_set_fields(const struct ble_hs_adv_fields *fields);
int ble_gap_adv_start(uint8_t own, const ble_addr_t *to, int32_t ms, const struct ble_gap_adv_params *how,
                      ble_gap_event_fn *told, void *user);

struct ble_hs_cfg {
    void (*sync_cb)(void);
};
extern struct ble_hs_cfg ble_hs_cfg;
#endif
