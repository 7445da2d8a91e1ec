"""Measurement operation: claims, data sets, actuators, streams, clock, trigger (operation.md). Pure, both roles.

Nothing here does I/O, waits or reads a clock. Times are integers: node ticks and station times in ns, ``gap`` in µs,
leases in s, dead-men in ms. Data sets are raw octets as in ModLenth and DatModel.

Contents
--------
===================  =================================================================================================
``commands``         payloads of claims and values: ``OperateCommand`` ``idle`` ``OperationReply`` ``read_data_set``
                     ``write_data_set`` ``sample`` ``SampleReply`` ``set_values`` ``run_self_test`` ``PowerReply``
``stream_commands``  payloads of streams and time: ``SubscribeCommand`` ``SubscribeReply`` ``stop`` ``drive``
                     ``DriveReply`` ``CLOCK`` ``ClockReply`` ``ArmCommand``; builders give a ``Command`` for
                     ``Conversation.request``
``datagram``         data and Drive messages: run keys, ``DatagramSealer``, ``Layout``, the test pattern
``can_frames``       identifiers and cutting on CAN and BLE: ``cut`` ``StreamAssembly`` ``data_address``
                     ``trigger_station``
``budget``           the node's budget in ppm, the load of a CAN bus
``subscription``     station: ``StreamPlan`` (Subscribe and the check of its reply), ``Receiver`` (opens messages)
``timing``           station: ``ClockSample`` (offset, bound, dishonest clocks), ``TriggerToken``
``driving``          station: ``Driver`` (Drive messages)
``hardware``         node: the interface of the firmware below (``Hardware``, ``SessionPort``)
``claims``           node: claims, leases, dead-men, safe states
``streams``          node: streams, their budget, messages being filled and sent
``stream_role``      node: the commands of streams, Drive, clock and trigger
``role``             node: every command of operation.md inside a session; used by ``Tim``
===================  =================================================================================================

A station, in order
-------------------
>>> plan = StreamPlan.for_channels(0, ((1, 2),), n=25, period=1_000_000)   # stream 0: channel 1 of 2 octets, 1 kHz
>>> reply = plan.accept(conversation.request(plan.command(), "to subscribe"), now)
>>> receiver = Receiver(plan, reply, session.message_key)          # k_m: StationSession.message_key
>>> assembly = StreamAssembly(plan.length, fd=False)               # one for each (node, stream)
>>> octets = assembly.add_segment(address.segment, frame.data)     # address = data_address(identifier)
>>> message = receiver.open_message(octets, clock_sample.tick(time.monotonic_ns()))   # None: see receiver.counts

A node
------
``Tim(..., hardware=...)``; the link reports what only a link knows:

* ``tim.handle(frame, link=…, tapped=…)`` as before; then, when the reply has left, ``tim.reply_sent(link)``;
* ``tim.poll()`` again and again: takes samples, runs leases and dead-men; gives the seconds until it wants to be
  called again. ``tim.event(channel, tick, data_set, valid)`` whenever an event sensor has seen one;
* ``tim.next_frame_in()`` and ``tim.next_frame(bus)`` for a link that streams: when the next data frame may begin, and
  that frame; one at a time to the controller;
* ``tim.trigger(link, token, tick)`` and ``tim.drive(link, octets)`` for what comes without a reply;
* ``tim.actuator_claimed()`` before it moves to another CAN address; ``tim.link_lost(link)`` at bus-off, as before.
"""
