#include "plush_device.h"

int main() { plush_device_run(); }
