# SPDX-License-Identifier: Apache-2.0
# The Zephyr port and the example boards, compiled and run on this machine over a stand-in for the kernel and its drivers
# (port/zephyr/standin): `make boards`. On Zephyr: zephyr/CMakeLists.txt.

BOARDS := loadcell_hx711 gripper_servo
STANDIN := port/zephyr/standin
OF_ZEPHYR := -DTEDS_SHA256_OCTETS=256 -DCONFIG_TEDS_NODE=1 -DCONFIG_TEDS_NODE_CAN=1 \
  -DCONFIG_TEDS_NODE_STACK=8192 -DCONFIG_TEDS_NODE_PRIORITY=7 -DCONFIG_TEDS_NODE_DRIFT=50 \
  -DCONFIG_GPIO=1 '-DCONFIG_BOARD_TARGET="standin"' '-DCONFIG_TEDS_NODE_APPLICATION="board"'

.PHONY: boards
boards: $(BOARDS:%=$(BUILD)/boards/%)

# As their prj.conf say it.
FD_loadcell_hx711 := -DTEDS_CAN_FD=0
FD_gripper_servo := -DTEDS_CAN_FD=1 -DCONFIG_TEDS_NODE_CAN_FD=1

$(BUILD)/boards/%: $(SOURCES) $(HEADERS) port/psa/teds_psa.c $(wildcard port/zephyr/*.[ch] $(STANDIN)/*.c $(STANDIN)/zephyr/*/*.h boards/*/src/*.[ch])
	@mkdir -p $(@D)
	$(CC) $(WARNINGS) $(LEVEL) $(DEBUG) -pthread $(OF_ZEPHYR) $(FD_$*) -Iinclude -Isrc -Iport/psa -Iport/zephyr -Iport/posix -I$(STANDIN) \
	  $(SOURCES) port/psa/teds_psa.c port/zephyr/node_thread.c port/zephyr/flash.c port/zephyr/firmware.c port/zephyr/can_bus.c \
	  $(wildcard boards/$*/src/*.c) $(wildcard $(STANDIN)/*.c) \
	  port/posix/bus.c port/posix/multicast.c port/posix/socketcand.c port/posix/pacing.c port/posix/flash_file.c \
	  -o $@.new -lmbedcrypto -lm
	@mv $@.new $@

# What no machine here has, a reader's chip and a Bluetooth controller: compiled, not run.
.PHONY: boards-radio
boards-radio:
	$(CC) $(WARNINGS) $(OF_ZEPHYR) -DCONFIG_TEDS_NODE_NFC_T4T=1 -DCONFIG_TEDS_NODE_BLE=1 -DTEDS_NFC=1 -DTEDS_BLE=1 \
	  -Iinclude -Isrc -Iport/psa -Iport/zephyr -I$(STANDIN) -fsyntax-only $(wildcard port/zephyr/*.c)

# The ESP32 port and its Arduino sketch over a stand-in for ESP-IDF and Arduino (port/esp32/standin): compiled and run.
OF_ESP32 := -DESP_PLATFORM -Iport/esp32 -Iport/esp32/standin
.PHONY: esp32
esp32: $(BUILD)/boards/angle_sensor

$(BUILD)/boards/angle_sensor: $(SOURCES) $(HEADERS) $(wildcard port/esp32/*.[ch] port/esp32/standin/* port/esp32/standin/*/*) \
  examples/AngleSensor/AngleSensor.ino
	@mkdir -p $(BUILD)/boards/esp32
	cd $(BUILD)/boards/esp32 && $(CC) $(WARNINGS) $(LEVEL) $(DEBUG) -DTEDS_CAN_FD=0 $(subst -I,-I$(CURDIR)/,$(OF_ESP32) $(INCLUDES)) -c \
	  $(addprefix $(CURDIR)/,$(SOURCES) port/bearssl/teds_bearssl.c port/esp32/teds_esp32.c port/esp32/standin/idf.c \
	  port/posix/bus.c port/posix/multicast.c port/posix/socketcand.c port/posix/pacing.c)
	$(CXX) -std=c++11 -Wall -Wextra $(DEBUG) -DTEDS_CAN_FD=0 $(OF_ESP32) $(INCLUDES) -include Arduino.h -xc++ examples/AngleSensor/AngleSensor.ino \
	  port/esp32/standin/arduino.cpp -xnone $(BUILD)/boards/esp32/*.o -o $@.new -lbearssl -lm
	@mv $@.new $@

# The library in the form that Arduino wants, to be copied into its folder `libraries`: build/arduino/TedsNode. With BearSSL's
# source (BEARSSL) it holds what is needed of that, too.
ARDUINO := $(BUILD)/arduino/TedsNode
.PHONY: arduino
arduino:
	@rm -rf $(ARDUINO) && mkdir -p $(ARDUINO)/src $(ARDUINO)/examples
	cp -r include/teds src/*.c src/*.h port/bearssl/teds_bearssl.[ch] port/esp32/teds_esp32.[ch] $(ARDUINO)/src
	cp -r examples/AngleSensor $(ARDUINO)/examples
	cp library.properties README.md CHANGELOG.md ../LICENSE $(ARDUINO)
	@if [ -f $(BEARSSL)/inc/bearssl.h ]; then \
	  cp $(BEARSSL)/inc/*.h $(BEARSSL)/src/inner.h $(ARDUINO)/src && mkdir $(ARDUINO)/src/bearssl && \
	  cp $(BEARSSL_SOURCES) $(ARDUINO)/src/bearssl && cp $(BEARSSL)/LICENSE.txt $(ARDUINO)/src/bearssl && \
	  sed -n 's/^-D\(.*\)=\(.*\)/#define \1 \2/p' port/bearssl/flags.txt >$(ARDUINO)/src/config.h; fi
	@echo $(ARDUINO)
