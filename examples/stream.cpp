// A capture loop: g++ -std=c++17 stream.cpp -o stream && ./stream HOST PORT MODEL VIEWS KEYPOINTS
// Lifts frames as they come, prints the number and the points of each, x y z after x y z. In place
// of stdin, a frame is what your detector says: VIEWS x KEYPOINTS x (x, y), float32, or NaN.
#include <cstdio>
#include <netdb.h>
#include <stdexcept>
#include <string>

struct WebSocket {
  FILE *in, *out;
  WebSocket(const std::string& host, const std::string& port, const std::string& path) {
    addrinfo* at;
    check(!getaddrinfo(host.c_str(), port.c_str(), nullptr, &at), "there is no such host");
    int socket = ::socket(at->ai_family, SOCK_STREAM, 0);
    check(!connect(socket, at->ai_addr, at->ai_addrlen), "the service cannot be reached");
    in = fdopen(socket, "r"), out = fdopen(socket, "w");
    put("GET " + path + " HTTP/1.1\r\nHost: " + host + ":" + port + "\r\nUpgrade: websocket\r\n" +
        "Connection: Upgrade\r\nSec-WebSocket-Key: ZmV3dmlldyBleGFtcGxlIQ==\r\n" +
        "Sec-WebSocket-Version: 13\r\n\r\n");
    std::string head;
    while (head.find("\r\n\r\n") == std::string::npos) head += get(1);
    check(!head.compare(9, 3, "101"), head);
  }
  void check(bool well, const std::string& why) { if (!well) throw std::runtime_error(why); }
  void put(const std::string& data) { fwrite(data.data(), data.size(), 1, out), fflush(out); }
  std::string get(size_t size) {
    std::string data(size, 0);
    check(fread(&data[0], 1, size, in) == size, "the connection was lost");
    return data;
  }
  void send(int kind, const std::string& data) {  // text or bytes, to 64 KiB; masked with zeros
    std::string head{char(0x80 | kind), char(0xfe), char(data.size() >> 8), char(data.size())};
    if (data.size() < 126) head = {head[0], char(0x80 | data.size())};
    put(head + std::string(4, 0) + data);
  }
  std::string receive(int expected) {
    std::string head = get(2), size = head[1] == 126 ? get(2) : std::string{0, head[1]};
    std::string data = get(256 * (size[0] & 255) + (size[1] & 255));
    if ((head[0] & 15) == 9) return send(10, data), receive(expected);  // a ping
    check((head[0] & 15) == expected, data);  // else JSON that says what is wrong
    return data;
  }
};

int main(int, char** told) {
  WebSocket stream(told[1], told[2], "/lift/stream");
  stream.send(1, std::string("{\"model\": \"") + told[3] + "\"}");
  std::string ready = stream.receive(1), frame{1, 0, char(std::stoi(told[4])), 0, 0, 0, 0, 0};
  stream.check(ready.find("\"ready\"") != std::string::npos, ready);
  frame.resize(8 + 8 * std::stoi(told[4]) * std::stoi(told[5]));  // kind, flags, views, sequence
  for (auto& n = (unsigned&)frame[4]; fread(&frame[8], frame.size() - 8, 1, stdin); ++n) {
    stream.send(2, frame);
    std::string answer = stream.receive(2);  // the same header, then points3d
    auto points = (const float*)&answer[8];
    printf("%u", n);
    for (int i = 0; i < 3 * std::stoi(told[5]); ++i) printf(" %.9g", points[i]);
    puts(""), fflush(stdout);
  }
}
