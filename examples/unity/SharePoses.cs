// Moves a Unity object by the poses of a SHARE agent on this machine:
//     share agent realsense --name ann --kind ar --edge tcp://H:P --poses udp://127.0.0.1:5570
// Put it on a GameObject that stands for the device (D435i). Anchor shared content to the object's parent.

using System;
using System.Net;
using System.Net.Sockets;
using System.Text;
using UnityEngine;

public class SharePoses : MonoBehaviour
{
    public int port = 5570;
    [Tooltip("Hide what is shared while the place in the map is not known")] public GameObject shared;

    // examples/conventions.json, "unity": a test holds these against it. Rows.
    static readonly float[,] World = { { 0, -1, 0 }, { 0, 0, 1 }, { 1, 0, 0 } };
    static readonly float[,] Body = { { 1, 0, 0 }, { 0, -1, 0 }, { 0, 0, 1 } };

    [Serializable] class InFrame { public double[] position; public double[] quaternion; }
    [Serializable] class Message { public int schema; public string state; public InFrame map; public string map_id; }

    UdpClient socket;

    void OnEnable() { socket = new UdpClient(new IPEndPoint(IPAddress.Loopback, port)); }
    void OnDisable() { socket.Close(); }

    void Update()
    {
        byte[] newest = null;
        IPEndPoint from = null;
        while (socket.Available > 0) newest = socket.Receive(ref from);
        if (newest == null) return;
        Message message = JsonUtility.FromJson<Message>(Encoding.UTF8.GetString(newest));
        if (message.schema != 3) return;
        // JsonUtility makes an empty object of null
        bool isKnown = message.map != null && message.map.position != null && message.map.position.Length == 3;
        if (shared != null) shared.SetActive(isKnown);
        if (!isKnown) return;
        transform.localPosition = ToWorld(message.map.position[0], message.map.position[1], message.map.position[2]);
        transform.localRotation = ToRotation(message.map.quaternion);
    }

    static Vector3 ToWorld(double x, double y, double z)
    {
        return new Vector3(Row(World, 0, x, y, z), Row(World, 1, x, y, z), Row(World, 2, x, y, z));
    }

    // R' = World R Body^-1, of which column j is what the body's axis j becomes; Body is its own inverse.
    static Quaternion ToRotation(double[] q)
    {
        return Quaternion.LookRotation(Axis(q, 2), Axis(q, 1));
    }

    static Vector3 Axis(double[] q, int j)
    {
        double x = Body[0, j], y = Body[1, j], z = Body[2, j];
        // v + 2 w (u x v) + 2 u x (u x v), with q = (u, w)
        double cx = q[1] * z - q[2] * y, cy = q[2] * x - q[0] * z, cz = q[0] * y - q[1] * x;
        double dx = q[1] * cz - q[2] * cy, dy = q[2] * cx - q[0] * cz, dz = q[0] * cy - q[1] * cx;
        return ToWorld(x + 2 * (q[3] * cx + dx), y + 2 * (q[3] * cy + dy), z + 2 * (q[3] * cz + dz));
    }

    static float Row(float[,] m, int i, double x, double y, double z)
    {
        return (float)(m[i, 0] * x + m[i, 1] * y + m[i, 2] * z);
    }
}
