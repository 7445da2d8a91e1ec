# SPDX-License-Identifier: Apache-2.0
# The Zephyr port and the example boards, compiled and run on this machine over a stand-in for the kernel and its drivers
# (port/zephyr/standin): `make boards`. On Zephyr: zephyr/CMakeLists.txt.

BOARDS := loadcell_hx711 gripper_servo
STANDIN := port/zephyr/standin
OF_ZEPHYR := -DTEDS_SHA256_OCTETS=256 -DCONFIG_TEDS_NODE=1 -DCONFIG_TEDS_NODE_CAN=1 \
  -DCONFIG_TEDS_NODE_STACK=8192 -DCONFIG_TEDS_NODE_PRIORITY=7 -DCONFIG_TEDS_NODE_DRIFT=50

.PHONY: boards
boards: $(BOARDS:%=$(BUILD)/boards/%)

# As their prj.conf say it.
FD_loadcell_hx711 := -DTEDS_CAN_FD=0
FD_gripper_servo := -DTEDS_CAN_FD=1 -DCONFIG_TEDS_NODE_CAN_FD=1

$(BUILD)/boards/%: $(SOURCES) $(HEADERS) port/psa/teds_psa.c $(wildcard port/zephyr/*.[ch] $(STANDIN)/*.c $(STANDIN)/zephyr/*/*.h boards/*/src/*.[ch])
	@mkdir -p $(@D)
	$(CC) $(WARNINGS) $(LEVEL) -g -pthread $(OF_ZEPHYR) $(FD_$*) -Iinclude -Isrc -Iport/psa -Iport/zephyr -Iport/posix -I$(STANDIN) \
	  $(SOURCES) port/psa/teds_psa.c port/zephyr/node_thread.c port/zephyr/flash.c port/zephyr/can_bus.c \
	  $(wildcard boards/$*/src/*.c) $(wildcard $(STANDIN)/*.c) \
	  port/posix/bus.c port/posix/multicast.c port/posix/socketcand.c port/posix/pacing.c port/posix/flash_file.c \
	  -o $@.new -lmbedcrypto -lm
	@mv $@.new $@

# What no machine here has, a reader's chip and a Bluetooth controller: compiled, not run.
.PHONY: boards-radio
boards-radio:
	$(CC) $(WARNINGS) $(OF_ZEPHYR) -DCONFIG_TEDS_NODE_NFC_T4T=1 -DCONFIG_TEDS_NODE_BLE=1 -DTEDS_NFC=1 -DTEDS_BLE=1 \
	  -Iinclude -Isrc -Iport/psa -Iport/zephyr -I$(STANDIN) -fsyntax-only $(wildcard port/zephyr/*.c)
