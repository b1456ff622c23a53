#include "idf.h"
void nimble_port_freertos_init(TaskFunction_t host);
void nimble_port_freertos_deinit(void);
