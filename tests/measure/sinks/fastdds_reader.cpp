// Another maker's DDS as a late joiner: prints what it discovers and the octets of the topics that it is told to read.
// fastdds_reader DOMAIN SECONDS PUBLISH_TOPIC (or -) then pairs TOPIC TYPE; a topic ending in "!" is read transient local.
#include <chrono>
#include <cstdlib>
#include <functional>
#include <iomanip>
#include <iostream>
#include <map>
#include <mutex>
#include <sstream>
#include <thread>
#include <unistd.h>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipantListener.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/participant/ParticipantDiscoveryInfo.h>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastdds/rtps/writer/WriterDiscoveryInfo.h>

namespace api = eprosima::fastdds::dds;
namespace wire = eprosima::fastrtps::rtps;

struct Octets {
    std::vector<unsigned char> data;
};

class AnyType : public api::TopicDataType {
public:
    explicit AnyType(const std::string& name) {
        setName(name.c_str());
        m_typeSize = 1 << 20;
        m_isGetKeyDefined = false;
    }
    bool serialize(void* from, wire::SerializedPayload_t* to) override {
        auto& octets = static_cast<Octets*>(from)->data;
        to->length = octets.size();
        std::copy(octets.begin(), octets.end(), to->data);
        to->encapsulation = CDR_LE;
        return true;
    }
    bool deserialize(wire::SerializedPayload_t* from, void* to) override {
        static_cast<Octets*>(to)->data.assign(from->data, from->data + from->length);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void* from) override {
        return [from] { return static_cast<uint32_t>(static_cast<Octets*>(from)->data.size()); };
    }
    void* createData() override { return new Octets; }
    void deleteData(void* data) override { delete static_cast<Octets*>(data); }
    bool getKey(void*, wire::InstanceHandle_t*, bool) override { return false; }
};

static std::mutex out;

class Listener : public api::DomainParticipantListener {
public:
    void on_participant_discovery(api::DomainParticipant*, wire::ParticipantDiscoveryInfo&& info) override {
        if (info.status != wire::ParticipantDiscoveryInfo::DISCOVERED_PARTICIPANT) return;
        std::lock_guard<std::mutex> lock(out);
        std::cout << "participant " << std::string(info.info.m_userData.begin(), info.info.m_userData.end()) << std::endl;
    }
    void on_publisher_discovery(api::DomainParticipant*, wire::WriterDiscoveryInfo&& info) override {
        if (info.status != wire::WriterDiscoveryInfo::DISCOVERED_WRITER) return;
        auto& qos = info.info.m_qos;
        std::lock_guard<std::mutex> lock(out);
        std::cout << "writer " << info.info.topicName() << " " << info.info.typeName() << " "
                  << std::string(qos.m_userData.begin(), qos.m_userData.end()) << std::endl;
    }
};

static api::DomainParticipantQos only_this_machine(int domain) {
    api::DomainParticipantQos qos;
    auto transport = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    transport->interfaceWhiteList.push_back("127.0.0.1");
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(transport);
    const int base = 7400 + 250 * domain + 10;
    for (int index = 0; index < 8; index++) {
        wire::Locator_t peer;
        peer.kind = LOCATOR_KIND_UDPv4;
        wire::IPLocator::setIPv4(peer, "127.0.0.1");
        peer.port = base + 2 * index;
        qos.wire_protocol().builtin.initialPeersList.push_back(peer);
        if (index == 7) qos.wire_protocol().builtin.metatrafficUnicastLocatorList.push_back(peer);
    }
    return qos;
}

int main(int count, char** words) {
    const int domain = std::atoi(words[1]);
    const double seconds = std::atof(words[2]);
    const std::string publish = words[3];
    Listener listener;
    auto participant = api::DomainParticipantFactory::get_instance()->create_participant(
        domain, only_this_machine(domain), &listener, api::StatusMask::none());
    auto subscriber = participant->create_subscriber(api::SUBSCRIBER_QOS_DEFAULT);
    std::vector<std::pair<std::string, api::DataReader*>> readers;
    for (int k = 4; k + 1 < count; k += 2) {
        std::string name = words[k];
        const bool latched = name.back() == '!';
        if (latched) name.pop_back();
        api::TypeSupport type(new AnyType(words[k + 1]));
        type.register_type(participant);
        auto topic = participant->create_topic(name, words[k + 1], api::TOPIC_QOS_DEFAULT);
        api::DataReaderQos qos;
        qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
        qos.reliability().kind = api::RELIABLE_RELIABILITY_QOS;
        if (latched) qos.durability().kind = api::TRANSIENT_LOCAL_DURABILITY_QOS;
        readers.emplace_back(name, subscriber->create_datareader(topic, qos));
    }
    api::DataWriter* writer = nullptr;
    if (publish != "-") {
        api::TypeSupport type(new AnyType("std_msgs::msg::dds_::Float64_"));
        type.register_type(participant);
        auto topic = participant->create_topic(publish, "std_msgs::msg::dds_::Float64_", api::TOPIC_QOS_DEFAULT);
        api::DataWriterQos qos;
        qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
        writer = participant->create_publisher(api::PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos);
    }
    Octets command{{0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0xF4, 0x3F}};  // CDR little-endian, 1.25
    const auto end = std::chrono::steady_clock::now() + std::chrono::milliseconds(int(seconds * 1000));
    std::map<std::string, int> seen;
    while (std::chrono::steady_clock::now() < end) {
        for (auto& [name, reader] : readers) {
            Octets octets;
            api::SampleInfo info;
            while (reader->take_next_sample(&octets, &info) == eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) {
                if (!info.valid_data || seen[name]++ > 2000) continue;
                std::ostringstream hex;
                for (unsigned char octet : octets.data) hex << std::hex << std::setw(2) << std::setfill('0') << int(octet);
                std::lock_guard<std::mutex> lock(out);
                std::cout << "sample " << name << " " << hex.str() << std::endl;
            }
        }
        if (writer != nullptr) writer->write(&command);
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
    std::cout.flush();
    _exit(0);  // the library's own end takes seconds
}
