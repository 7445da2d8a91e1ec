# SPDX-License-Identifier: Apache-2.0
# Cross builds for Cortex-M0+, M4 and M33: sizes of the library, stack of each function, images for qemu. Included by Makefile.

ARM := arm-none-eabi-
ARM_FLAGS := -mthumb -Os -ffunction-sections -fdata-sections -fstack-usage -fcallgraph-info=su
BEARSSL ?= $(BUILD)/bearssl
BEARSSL_SOURCES := $(addprefix $(BEARSSL)/,$(shell grep -v '^\#' port/bearssl/sources.txt))
BEARSSL_FLAGS := $(shell grep -v '^\#' port/bearssl/flags.txt)

CPU_m0 := -mcpu=cortex-m0plus -DTEDS_BEARSSL_M15
CPU_m4 := -mcpu=cortex-m4
CPU_m33 := -mcpu=cortex-m33
CPUS := m0 m4 m33
# All on CAN; security alone; with updates; with NFC; with NFC and BLE.
LIBRARY_full :=
LIBRARY_security := -DTEDS_OPERATION=0 -DTEDS_CAN_FD=0
LIBRARY_managed := -DTEDS_MANAGED=1
LIBRARY_nfc := -DTEDS_NFC=1
LIBRARY_ble := -DTEDS_NFC=1 -DTEDS_BLE=1

.PHONY: arm
arm: $(foreach cpu,$(CPUS),$(foreach what,full.a security.a managed.a nfc.a ble.a measure.elf steps.elf,$(BUILD)/arm/$(cpu)-$(what))) \
  $(BUILD)/arm/m4-node.elf

define LIBRARY_RULE
$(BUILD)/arm/$(1)-$(2).a: $(SOURCES) $(HEADERS)
	@mkdir -p $(BUILD)/arm/$(1)-$(2)
	cd $(BUILD)/arm/$(1)-$(2) && $(ARM)gcc $(filter-out -Wmissing-prototypes,$(WARNINGS)) $(ARM_FLAGS) $(CPU_$(1)) \
	  $(LIBRARY_$(2)) -I$(CURDIR)/include -I$(CURDIR)/src -c $(addprefix $(CURDIR)/,$(SOURCES))
	@rm -f $$@
	$(ARM)ar rcs $$@ $(BUILD)/arm/$(1)-$(2)/*.o
endef
$(foreach cpu,$(CPUS),$(foreach size,full security managed nfc ble,$(eval $(call LIBRARY_RULE,$(cpu),$(size)))))

define BEARSSL_RULE
$(BUILD)/arm/$(1)-bearssl.a: port/bearssl/teds_bearssl.c $(wildcard port/bearssl/*.txt) $(HEADERS) arm.mk
	@test -f $(BEARSSL)/inc/bearssl.h || { echo "BearSSL's source is missing: run scripts/install-firmware-packages"; exit 1; }
	@mkdir -p $(BUILD)/arm/$(1)-bearssl
	cd $(BUILD)/arm/$(1)-bearssl && $(ARM)gcc -std=c99 $(ARM_FLAGS) $(CPU_$(1)) $(BEARSSL_FLAGS) \
	  -I$(abspath $(BEARSSL))/inc -I$(abspath $(BEARSSL))/src -I$(CURDIR)/include \
	  -c $(abspath $(BEARSSL_SOURCES)) $(CURDIR)/port/bearssl/teds_bearssl.c
	@rm -f $$@
	$(ARM)ar rcs $$@ $(BUILD)/arm/$(1)-bearssl/*.o
endef
$(foreach cpu,$(CPUS),$(eval $(call BEARSSL_RULE,$(cpu))))

# The machines of qemu. No Cortex-M0 there has the RAM of a whole node: what was compiled for an M0+ takes its steps on an M4,
# which runs the same instructions.
MPS2 := -Wl,--defsym=ROM_ORIGIN=0 -Wl,--defsym=RAM_ORIGIN=0x20000000 -Wl,--defsym=ROM_LENGTH=0x400000 -Wl,--defsym=RAM_LENGTH=0x400000
MACHINE_m0-measure := -DTEDS_MICROBIT -Wl,--defsym=ROM_ORIGIN=0 -Wl,--defsym=RAM_ORIGIN=0x20000000 \
  -Wl,--defsym=ROM_LENGTH=0x40000 -Wl,--defsym=RAM_LENGTH=0x4000
MACHINE_m0-steps := $(MPS2)
MACHINE_m4-measure := $(MPS2)
MACHINE_m4-steps := $(MPS2)
MACHINE_m4-node := $(MPS2)
AN505 := -DTEDS_AN505 -Wl,--defsym=ROM_ORIGIN=0x10000000 -Wl,--defsym=RAM_ORIGIN=0x38000000 \
  -Wl,--defsym=ROM_LENGTH=0x400000 -Wl,--defsym=RAM_LENGTH=0x200000
MACHINE_m33-measure := $(AN505)
MACHINE_m33-steps := $(AN505)
SOURCES_node = port/qemu/serial.c
SOURCES_steps = -I$(VECTORS) $(VECTORS)/teds_vectors_kat.c
define IMAGE_RULE
$(BUILD)/arm/$(1)-$(2).elf: $(wildcard port/qemu/*) $(BUILD)/arm/$(1)-full.a $(BUILD)/arm/$(1)-bearssl.a
	$(ARM)gcc -std=gnu11 -Wall -Wextra -mthumb -Os $(CPU_$(1)) -ffunction-sections -fdata-sections -Iinclude -Isrc -Iport/bearssl \
	  -I$(BEARSSL)/inc $(MACHINE_$(1)-$(2)) -nostartfiles --specs=nano.specs -Wl,--gc-sections -T port/qemu/image.ld \
	  port/qemu/start.c port/qemu/$(2).c $(SOURCES_$(2)) $(BUILD)/arm/$(1)-full.a $(BUILD)/arm/$(1)-bearssl.a -lc -lgcc -o $$@
endef
$(foreach cpu,$(CPUS),$(foreach image,measure steps,$(eval $(call IMAGE_RULE,$(cpu),$(image)))))
$(eval $(call IMAGE_RULE,m4,node))
